"""Bounds of a correction's weights; without numpy, which clients of a bench do without."""

GREATEST_WEIGHT = 1.5
"""Of any function of a correction, in units of its opening or shift."""
MOST_WEIGHTS = 128
"""Of a correction: a downswing of half a second."""
