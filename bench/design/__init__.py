"""Design of swings."""
