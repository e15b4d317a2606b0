"""Monitors of sensors, exhausts, manifold, guard lock and encoders."""
