"""Records and series in the formats of other programs."""
