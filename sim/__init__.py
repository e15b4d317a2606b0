"""Simulation of robot, pneumatics, impact and ball flight."""
