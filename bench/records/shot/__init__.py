"""A shot: club and ball, planned, struck, read from a record."""
