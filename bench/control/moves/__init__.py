"""Moves: swing, slow move, homing, brake, hold, and their references."""
