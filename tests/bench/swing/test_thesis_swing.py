"""The downswing of the thesis, Appendix B: its demands on actuators and club."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from sim.kane import inverse_dynamics
from sim.kinematics import forward_kinematics, theta2_from_right_arm
from sim.robot import thesis_robot

ROBOT = thesis_robot()
BEGIN, TURNED_BACK = 0.686, -2.639 * 0.68
"""Start of the downswing (s), and the shoulder's turn there (rad)."""
TIME = BEGIN + 0.01 * np.arange(17)
ABSCISSA = BEGIN - 3.0 + 0.33 * np.arange(17)
"""Abscissa of the tanh curves, which is not time."""
SHOULDER = 11.80 * (TIME - 0.68) + TURNED_BACK
ARM = (np.tanh(ABSCISSA) - 1.0) * 0.1025
WRIST = (7.976 + np.tanh(ABSCISSA)) * 1.4 / 2.0
ARM_AT_ADDRESS, WRIST_AT_ADDRESS = -(np.tanh(-3.0) + 1.0) * 0.10175, -(np.tanh(-3.0) - 35.0) * 0.3491 / 2.0


def test_downswing_of_thesis_has_known_effort_and_speed() -> None:
    """A spline through the downswing's samples; assumed: rod at 0.22 m and shaft straight down at address.

    "About 380 N m, 1.3 kN, 165 N m" were calculated elsewhere with an unrecorded differentiation; a
    spline gives 331, 1186, 168. The peak lies where the tanh abscissa (-2.314 + 33 t) has just passed 0.
    """
    theta2 = theta2_from_right_arm(ROBOT, ROBOT.l56 + 0.22 + ARM)
    address = float(theta2_from_right_arm(ROBOT, ROBOT.l56 + 0.22 + ARM_AT_ADDRESS))
    theta1 = (2.5 * np.pi - address - WRIST_AT_ADDRESS) % (2.0 * np.pi) - np.pi + SHOULDER
    spline = CubicSpline(TIME, np.stack([theta1, theta2, WRIST], axis=-1))
    t = np.arange(BEGIN, TIME[-1], 1e-4)
    q, u, u_dot = spline(t), spline(t, 1), spline(t, 2)
    effort = np.abs(inverse_dynamics(ROBOT, q, u, u_dot)).max(axis=0)
    assert effort == pytest.approx([380.0, 1300.0, 165.0], rel=0.15)
    assert effort == pytest.approx([331.0, 1186.0, 168.2], rel=0.01)
    head = forward_kinematics(ROBOT, q)[:, :2]
    speed = np.hypot(*np.gradient(head, t, axis=0).T)
    assert speed.max() == pytest.approx(55.7, rel=0.01)
    assert t[speed.argmax()] - BEGIN == pytest.approx(0.072, abs=0.001)
    back = np.interp(0.0, SHOULDER, TIME)  # the shoulder is at its start again
    assert back == pytest.approx(0.8321, abs=1e-4)
    assert 19.0 <= np.interp(back, t, speed) <= 20.0
