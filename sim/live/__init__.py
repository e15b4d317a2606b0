"""The simulated plant beside a running loop."""
