"""Simulated benches: lock-step, replay and series of swings."""
