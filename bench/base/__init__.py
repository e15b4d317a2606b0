"""Base of all rooms: errors, states and causes, addresses, checked TOML and JSON, clock."""
