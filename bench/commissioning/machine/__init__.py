"""The path to the robot: bounded sequences, their process, a step's moves."""
