"""The run of a campaign: runner, shots on the bench or simulated, messages."""
