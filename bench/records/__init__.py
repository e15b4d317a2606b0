"""The records of a bench: from the ring to the file of a swing, and its shot."""
