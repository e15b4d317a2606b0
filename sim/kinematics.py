"""Kinematics of the parallel arm, both ways (thesis section 2.2).

Errata corrected: 1 (theta3 = thetaT - theta1 - theta2), 2 (atan2 takes y first), 3 (the right arm's
angle is theta1 + theta2 + theta4, pointing from R3 to R6).
"""

from __future__ import annotations

from math import cos, sin
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.base.compiled import compiled
from sim.robot import RobotParameters

Array = NDArray[np.float64]


class UnreachablePose(ValueError):
    """The wrist of the demanded pose lies outside the ring that shoulder link and left arm span."""


def forward_kinematics(robot: RobotParameters, q: ArrayLike) -> Array:
    """Return the club pose [x m, y m, theta_t rad] for joint angles `q` (rad); shapes (3,) or (..., 3).

    Thesis Eqs. 1-4. theta_t is the plain sum of the angles, not wrapped.
    """
    theta1, theta12, theta_t = np.moveaxis(np.cumsum(np.asarray(q, dtype=float), axis=-1), -1, 0)
    reach = robot.club.length_to_face
    x = robot.l12 * np.cos(theta1) + robot.l23 * np.cos(theta12) + reach * np.cos(theta_t)
    y = robot.l12 * np.sin(theta1) + robot.l23 * np.sin(theta12) + reach * np.sin(theta_t)
    return np.stack([x, y, theta_t], axis=-1)


def inverse_kinematics(robot: RobotParameters, pose: ArrayLike) -> Array:
    """Return joint angles (rad) that reach club `pose` [x m, y m, theta_t rad]; shapes (3,) or (..., 3).

    Thesis Eqs. 5-10 with errata 1 and 2; the robot's solution is the one with sin(theta2) < 0.
    theta1 is in (-pi, pi], theta2 in (pi, 2 pi), theta3 follows so that the angles sum to theta_t.

    Raises:
        UnreachablePose: the wrist is nearer or farther than the arm can place it, or not finite.
    """
    x, y, theta_t = np.moveaxis(np.asarray(pose, dtype=float), -1, 0)
    reach = robot.club.length_to_face
    wrist_x, wrist_y = x - reach * np.cos(theta_t), y - reach * np.sin(theta_t)
    distance = np.hypot(wrist_x, wrist_y)
    nearest, farthest = abs(robot.l12 - robot.l23), robot.l12 + robot.l23
    # Rounding may leave a pose that forward kinematics gave a hair outside.
    slack = 1e-12
    unreachable = ~((distance >= nearest - slack) & (distance <= farthest + slack))
    if np.any(unreachable):
        worst = np.atleast_2d(np.asarray(pose, dtype=float).reshape(-1, 3))[np.ravel(unreachable)][0]
        found = float(np.ravel(distance)[np.ravel(unreachable)][0])
        raise UnreachablePose(
            f"pose x = {worst[0]:.4g} m, y = {worst[1]:.4g} m, theta_t = {worst[2]:.4g} rad puts the wrist "
            f"{found:.4g} m from the shoulder axis; the arm reaches {nearest:.4g} to {farthest:.4g} m"
        )
    cosine = (distance**2 - robot.l12**2 - robot.l23**2) / (2 * robot.l12 * robot.l23)
    theta2 = 2 * np.pi - np.arccos(np.clip(cosine, -1.0, 1.0))
    elbow_angle = np.arctan2(robot.l23 * np.sin(theta2), robot.l12 + robot.l23 * np.cos(theta2))
    theta1 = np.arctan2(wrist_y, wrist_x) - elbow_angle
    theta1 = np.pi - np.mod(np.pi - theta1, 2 * np.pi)
    return np.stack([theta1, theta2, theta_t - theta1 - theta2], axis=-1)


def right_arm_length(robot: RobotParameters, theta2: ArrayLike) -> Array:
    """Return l46, wrist R3 to right shoulder R6 (m), for `theta2` (rad, any shape); law of cosines."""
    cosine = np.cos(np.asarray(theta2, dtype=float))
    length: Array = np.sqrt(robot.l62**2 + robot.l23**2 + 2 * robot.l62 * robot.l23 * cosine)
    return length


def theta2_from_right_arm(robot: RobotParameters, length: ArrayLike) -> Array:
    """Return theta2 (rad, third quadrant side: pi..2 pi) for right-arm length l46 (m, any shape).

    Raises:
        UnreachablePose: no theta2 gives that length.
    """
    length = np.asarray(length, dtype=float)
    cosine = (length**2 - robot.l62**2 - robot.l23**2) / (2 * robot.l62 * robot.l23)
    if not np.all(np.abs(cosine) <= 1.0 + 1e-12):
        shortest, longest = abs(robot.l62 - robot.l23), robot.l62 + robot.l23
        raise UnreachablePose(
            f"right arm of {np.ravel(length)[np.ravel(~(np.abs(cosine) <= 1.0))][0]:.4g} m; "
            f"the linkage allows {shortest:.4g} to {longest:.4g} m"
        )
    return np.pi + np.arccos(np.clip(-cosine, -1.0, 1.0))


def joint_positions(robot: RobotParameters, q: ArrayLike) -> Array:
    """Return the points R1, R2, R3, R6, T in the swing plane (m); shape (..., 5, 2)."""
    q = np.asarray(q, dtype=float)
    theta1, theta12, theta_t = np.moveaxis(np.cumsum(q, axis=-1), -1, 0)

    def ray(length: float, angle: Array) -> Array:
        return np.stack([length * np.cos(angle), length * np.sin(angle)], axis=-1)

    r2 = ray(robot.l12, theta1)
    r3 = r2 + ray(robot.l23, theta12)
    return np.stack(
        [np.zeros_like(r2), r2, r3, ray(-robot.l16, theta1), r3 + ray(robot.club.length_to_face, theta_t)],
        axis=-2,
    )


@compiled
def head_motion(
    r: Any, q1: float, q2: float, q3: float, u1: float, u2: float, u3: float
) -> tuple[float, float, float, float, float, float]:
    """Return x, y (m), theta_t (rad), vx, vy (m/s), omega (rad/s) of the face centre; `r` a ROBOT record."""
    w1, w2, w3 = u1, u1 + u2, u1 + u2 + u3
    a1, a2, a3 = q1, q1 + q2, q1 + q2 + q3
    c1, s1 = r.l12 * cos(a1), r.l12 * sin(a1)
    c2, s2 = r.l23 * cos(a2), r.l23 * sin(a2)
    c3, s3 = r.l3t * cos(a3), r.l3t * sin(a3)
    return (c1 + c2 + c3, s1 + s2 + s3, a3, -s1 * w1 - s2 * w2 - s3 * w3, c1 * w1 + c2 * w2 + c3 * w3, w3)
