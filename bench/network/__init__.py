"""The network side of a bench: sessions, roles, leases, commands and their answers."""
