"""What passes between a bench and its people: sessions, roles, leases, commands and their answers."""
