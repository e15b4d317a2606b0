"""Measured golfers: recordings of markers in, swings as joint angles out."""
