"""The right arm's own coordinates, which simulators with an explicit loop carry in addition to the joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.robot import RobotParameters

Array = NDArray[np.float64]


def with_right_arm(robot: RobotParameters, q: Array, u: Array) -> tuple[Array, Array]:
    """Return position and velocity of (theta1, theta2, theta3, rod's angle to the left arm, l46)."""
    link, arm = (np.array([np.cos(angle), np.sin(angle)]) for angle in np.cumsum(q)[:2])

    def turned(vector: Array) -> Array:
        return np.array([-vector[1], vector[0]])

    across = -robot.l16 * link - robot.l12 * link - robot.l23 * arm  # R3 to R6
    rate = -robot.l62 * u[0] * turned(link) - robot.l23 * (u[0] + u[1]) * turned(arm)
    length = float(np.hypot(*across))
    rod = across / length
    return (
        np.array([*q, np.arctan2(across[1], across[0]) - q[0] - q[1], length]),
        np.array([*u, turned(rod) @ rate / length - u[0] - u[1], rod @ rate]),
    )
