"""The simulated plant of a running bench."""
