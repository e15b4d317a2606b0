"""Where bodies stand: poses in the swing plane, the plane in the golf frame, the ball, the address.

The golf frame is that of `sim/impact.py`: X along the target line, Y up, Z to the right; the origin is on the
ground below the point of impact.
"""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from sim.kinematics import UnreachablePose, inverse_kinematics, joint_positions
from sim.plant import PlantParameters, Site
from sim.robot import RobotParameters

Array = NDArray[np.float64]


def plane_to_golf(robot: RobotParameters, site: Site) -> tuple[Array, Array]:
    """Return (axes, origin): golf = axes @ (x, y, z of the swing plane) + origin; (3, 3) and (3,) m."""
    c, s = cos(robot.lie), sin(robot.lie)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, s, c], [0.0, -c, s]])
    contact = np.array([0.0, (site.ball_y - site.ground) * s, 0.0])
    return axes, contact - axes @ np.array([site.ball_x, site.ball_y, 0.0])


def ball_at_rest(robot: RobotParameters, site: Site, radius: float) -> Array:
    """Return the centre of the ball on its tee in the golf frame (m): ahead of the face that meets it."""
    height = (site.ball_y - site.ground) * sin(robot.lie)
    return np.array([radius * cos(robot.club.loft), height + radius * sin(robot.club.loft), 0.0])


def body_poses(plant: PlantParameters, q: Array) -> dict[str, tuple[Array, Array]]:
    """Return each moving body's (translations (n, 3) m, quaternions xyzw (n, 4)) in the swing plane."""
    r1, r2, r3, r6, _ = np.moveaxis(joint_positions(plant.robot, q), -2, 0)
    theta1, theta12, theta_t = np.cumsum(q, axis=1).T
    right_arm = np.arctan2(*(r6 - r3).T[::-1])
    along = np.column_stack([np.cos(theta12), np.sin(theta12)])
    way = plant.wrist_stroke(q[:, 2])
    placed = {
        "shoulder_link": (r1, theta1),
        "left_arm": (r2, theta12),
        "wrist_rod": (r2 + way[:, None] * along, theta12),
        "club": (r3, theta_t),
        "right_arm_rod": (r3, right_arm),
        "right_arm_cylinder": (r6, right_arm + pi),
    }
    return {name: (_in_space(point), _about_z(angle)) for name, (point, angle) in placed.items()}


def _in_space(points: Array) -> Array:
    return np.column_stack([points, np.zeros(len(points))])


def _about_z(angle: Array) -> Array:
    half, nothing = angle / 2, np.zeros_like(angle)
    return np.column_stack([nothing, nothing, np.sin(half), np.cos(half)])


def address(plant: PlantParameters) -> Array:
    """Return joint angles (rad) with the face at the ball and the shaft straight down the swing plane.

    Raises:
        BenchError: the arm cannot put it there.
    """
    site = plant.site
    try:
        q = inverse_kinematics(plant.robot, [site.ball_x, site.ball_y, -pi / 2])
    except UnreachablePose as error:
        raise BenchError(
            "plant.site", str(error), "a ball within the arm's reach", "Correct ball_x or ball_y."
        ) from None
    middle = (plant.wrist.lower + plant.wrist.upper) / 2
    q[2] += 2 * pi * round((middle - q[2]) / (2 * pi))
    return q
