"""The loop of a bench: its cycle, the compiled tick, the snapshot a replay starts from."""
