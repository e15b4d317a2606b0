"""Gains of the three PIDs: margins of the loop, and how gains are found."""
