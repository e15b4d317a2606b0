"""Launches that a launch monitor tells of, and the swings they belong to, of a running bench."""
