"""Views of a running bench, a recorded swing or a series in Rerun."""
