"""Classes of received frames, each of which has a counter of the driver."""

CLASSES = (
    "positions",
    "late",
    "duplicates",
    "inputs",
    "analogue",
    "heartbeats",
    "boot_ups",
    "emergencies",
    "services",
    "wrong_length",
    "error_frames",
    "foreign",
)
"""Frame classes; their counters add up to `frames`."""
