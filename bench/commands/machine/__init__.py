"""Commands of a machine: calibration, commissioning, faults, sizing, doctor."""
