"""The robot, its air, the ball and its flight, as numbers."""
