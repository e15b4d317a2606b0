"""What people look at: a running bench, a past swing or a series, in Rerun."""
