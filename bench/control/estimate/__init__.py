"""Estimates: angles, velocities, chamber pressures, residuals of the model."""
