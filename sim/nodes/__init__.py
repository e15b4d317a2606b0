"""The simulated CANopen nodes."""
