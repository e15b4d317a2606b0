"""The test bench: control, swings, campaigns, telemetry and the command line."""
