"""Calibration: what was measured of this machine, by whom and when, and what is in force."""
