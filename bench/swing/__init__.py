"""Swings: references, profiles and the search for them."""
