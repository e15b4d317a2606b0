"""The way of a cycle's record: ring, recorder, export."""
