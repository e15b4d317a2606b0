"""Calibrations of this machine: values, author and date, and those in force."""
