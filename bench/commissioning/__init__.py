"""From an unknown robot to a known one: a fixed order of bounded steps, each documented and traceable."""
