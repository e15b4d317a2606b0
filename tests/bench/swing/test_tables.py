"""The tables of Appendix B: sample counts, seams, and what following them exactly would need."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from bench.swing.thesis_experiment import TOP, colon, joint_reference, thesis_swing
from sim.kane import inverse_dynamics
from sim.kinematics import forward_kinematics, right_arm_length
from sim.robot import thesis_robot

SWING = thesis_swing()
ROBOT = thesis_robot()


def test_sample_counts_and_times() -> None:
    for table in (SWING.shoulder, SWING.right_arm):
        assert table.value.shape == table.time.shape == (69 + 17,)
        assert np.array_equal(np.flatnonzero(table.time >= TOP), np.arange(69, 86))
        assert table.time[[0, 68, 69, 85]] == pytest.approx([0.0, 0.68, 0.686, 0.846])
    assert SWING.wrist.value.shape == SWING.wrist.time.shape == (41 + 29 + 17,)
    assert SWING.wrist.time[[0, 40, 41, 69, 70, 86]] == pytest.approx([0.0, 0.4, 0.4, 0.68, 0.686, 0.846])
    assert SWING.end == pytest.approx(0.846)


def test_junction_values() -> None:
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


def test_joint_reference_keeps_the_tables() -> None:
    t = SWING.shoulder.time
    q = joint_reference(SWING, ROBOT, t)
    assert q.shape == (86, 3)
    assert q[:, 0] - q[0, 0] == pytest.approx(SWING.shoulder.value)
    assert right_arm_length(ROBOT, q[:, 1]) == pytest.approx(0.34 + 0.22 + SWING.right_arm.value)
    assert np.all((q[:, 1] > np.pi) & (q[:, 1] < 1.5 * np.pi))
    # the assumed address: shaft straight down, both arms equally long but for the tanh's tail
    assert q[0].sum() % (2 * np.pi) == pytest.approx(1.5 * np.pi)
    assert right_arm_length(ROBOT, q[0, 1]) == pytest.approx(ROBOT.l23, abs=1e-3)


def test_after_the_last_sample_the_value_is_held() -> None:
    held = joint_reference(SWING, ROBOT, [0.846, 0.9])
    assert held[1] == pytest.approx(held[0])


def test_following_the_tables_exactly() -> None:
    """A spline through the downswing's samples: what the reference asks of actuators and of the club.

    "About 380 N m, 1.3 kN, 165 N m" were calculated elsewhere with an unrecorded differentiation; a
    spline gives 331, 1186, 168. The peak lies where the tanh abscissa (-2.314 + 33 t) has just passed 0.
    """
    samples = SWING.shoulder.time[SWING.shoulder.time >= TOP]
    spline = CubicSpline(samples, joint_reference(SWING, ROBOT, samples))
    t = np.arange(TOP, SWING.end, 1e-4)
    q, u, u_dot = spline(t), spline(t, 1), spline(t, 2)
    effort = np.abs(inverse_dynamics(ROBOT, q, u, u_dot)).max(axis=0)
    assert effort == pytest.approx([380.0, 1300.0, 165.0], rel=0.15)
    assert effort == pytest.approx([331.0, 1186.0, 168.2], rel=0.01)
    head = forward_kinematics(ROBOT, q)[:, :2]
    speed = np.hypot(*np.gradient(head, t, axis=0).T)
    assert speed.max() == pytest.approx(55.7, rel=0.01)
    assert t[speed.argmax()] - TOP == pytest.approx(0.072, abs=0.001)
    turned, down = SWING.shoulder, SWING.shoulder.time >= TOP
    back = np.interp(0.0, turned.value[down], turned.time[down])  # the shoulder is at its start again
    assert back == pytest.approx(0.8321, abs=1e-4)
    assert 19.0 <= np.interp(back, t, speed) <= 20.0
