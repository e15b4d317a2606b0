"""The thesis' own swing: its tables, and what they demand of actuators and club."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from bench.swing.golfers import BACKSWING_DURATION, colon, thesis_swing
from sim.kane import inverse_dynamics
from sim.kinematics import forward_kinematics, right_arm_length, theta2_from_right_arm
from sim.robot import thesis_robot

SWING = thesis_swing()
ROBOT = thesis_robot()


def joint_reference(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return joint angles (n, 3) of the tables; assumed: rod at 0.22 m and shaft straight down at address."""
    shoulder, arm, wrist = (
        np.interp(t, table.time, table.value) for table in (SWING.shoulder, SWING.right_arm, SWING.wrist)
    )
    theta2 = theta2_from_right_arm(ROBOT, ROBOT.l56 + 0.22 + arm)
    begin = float(theta2_from_right_arm(ROBOT, ROBOT.l56 + 0.22 + SWING.right_arm.value[0]))
    theta1 = (2.5 * np.pi - begin - SWING.wrist.value[0]) % (2.0 * np.pi) - np.pi + shoulder
    return np.stack([theta1, theta2, wrist], axis=-1)


def test_thesis_swing_has_sample_counts_and_times() -> None:
    for table in (SWING.shoulder, SWING.right_arm):
        assert table.value.shape == table.time.shape == (69 + 17,)
        assert np.array_equal(np.flatnonzero(table.time >= BACKSWING_DURATION), np.arange(69, 86))
        assert table.time[[0, 68, 69, 85]] == pytest.approx([0.0, 0.68, 0.686, 0.846])
    assert SWING.wrist.value.shape == SWING.wrist.time.shape == (41 + 29 + 17,)
    assert SWING.wrist.time[[0, 40, 41, 69, 70, 86]] == pytest.approx([0.0, 0.4, 0.4, 0.68, 0.686, 0.846])
    assert SWING.end == pytest.approx(0.846)


def test_thesis_swing_matches_junction_values() -> None:
    assert SWING.shoulder.value[[0, 68, 69, 85]] == pytest.approx(
        [0.0, -1.79452, -1.72372, 0.16428], abs=1e-9
    )
    assert SWING.right_arm.value[[68, 69]] == pytest.approx([-0.20298, -0.20302], abs=5e-6)
    assert SWING.wrist.value[[0, 40, 41, 69, 70, 86]] == pytest.approx(
        [6.2829, 5.9356, 5.9365, 4.8869, 4.8968, 6.2795], abs=5e-5
    )


def test_colon_counts_as_matlab_does() -> None:
    assert len(colon(0.0, 0.1, 0.3)) == 4  # 0.1 * 3 > 0.3 in floating point
    assert len(colon(0.0, 0.01, 0.686)) == 69
    assert colon(0.4 - 3, 0.2, 3.0)[-1] == pytest.approx(3.0)


def test_joint_reference_matches_tables() -> None:
    t = SWING.shoulder.time
    q = joint_reference(t)
    assert q.shape == (86, 3)
    assert q[:, 0] - q[0, 0] == pytest.approx(SWING.shoulder.value)
    assert right_arm_length(ROBOT, q[:, 1]) == pytest.approx(0.34 + 0.22 + SWING.right_arm.value)
    assert np.all((q[:, 1] > np.pi) & (q[:, 1] < 1.5 * np.pi))
    # the assumed address: shaft straight down, both arms equally long but for the tanh's tail
    assert q[0].sum() % (2 * np.pi) == pytest.approx(1.5 * np.pi)
    assert right_arm_length(ROBOT, q[0, 1]) == pytest.approx(ROBOT.l23, abs=1e-3)


def test_joint_reference_after_last_sample_holds_value() -> None:
    held = joint_reference(np.array([0.846, 0.9]))
    assert held[1] == pytest.approx(held[0])


def test_joint_reference_downswing_spline_has_known_effort_and_speed() -> None:
    """A spline through the downswing's samples: the reference's demand on actuators and club.

    "About 380 N m, 1.3 kN, 165 N m" were calculated elsewhere with an unrecorded differentiation; a
    spline gives 331, 1186, 168. The peak lies where the tanh abscissa (-2.314 + 33 t) has just passed 0.
    """
    samples = SWING.shoulder.time[SWING.shoulder.time >= BACKSWING_DURATION]
    spline = CubicSpline(samples, joint_reference(samples))
    t = np.arange(BACKSWING_DURATION, SWING.end, 1e-4)
    q, u, u_dot = spline(t), spline(t, 1), spline(t, 2)
    effort = np.abs(inverse_dynamics(ROBOT, q, u, u_dot)).max(axis=0)
    assert effort == pytest.approx([380.0, 1300.0, 165.0], rel=0.15)
    assert effort == pytest.approx([331.0, 1186.0, 168.2], rel=0.01)
    head = forward_kinematics(ROBOT, q)[:, :2]
    speed = np.hypot(*np.gradient(head, t, axis=0).T)
    assert speed.max() == pytest.approx(55.7, rel=0.01)
    assert t[speed.argmax()] - BACKSWING_DURATION == pytest.approx(0.072, abs=0.001)
    turned, down = SWING.shoulder, SWING.shoulder.time >= BACKSWING_DURATION
    back = np.interp(0.0, turned.value[down], turned.time[down])  # the shoulder is at its start again
    assert back == pytest.approx(0.8321, abs=1e-4)
    assert 19.0 <= np.interp(back, t, speed) <= 20.0
