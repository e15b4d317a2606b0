"""`golfbench demo`: the shipped test of two balls, in real time or in lock-step."""
