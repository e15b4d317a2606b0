"""Kinematics both ways: property tests over the whole workspace, refusals, right arm, batches."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.kinematics import (
    UnreachablePose,
    forward_kinematics,
    head_motion,
    inverse_kinematics,
    joint_positions,
    right_arm_length,
    theta2_from_right_arm,
)
from sim.robot import thesis_robot

ROBOT = thesis_robot()
NEAREST, FARTHEST = abs(ROBOT.l12 - ROBOT.l23), ROBOT.l12 + ROBOT.l23

turn = st.floats(-3 * pi, 3 * pi)
# At the ring's edges arm and link are in line and theta2 is known to the root of the rounding only.
arm_angle = st.floats(pi + 0.02, 2 * pi - 0.02)


def wrapped(angle: Any) -> Any:
    return np.mod(np.asarray(angle) + pi, 2 * pi) - pi


def pose_with_wrist_at(distance: float, direction: float, theta_t: float) -> np.ndarray:
    reach = ROBOT.club.length_to_face
    return np.array(
        [
            distance * np.cos(direction) + reach * np.cos(theta_t),
            distance * np.sin(direction) + reach * np.sin(theta_t),
            theta_t,
        ]
    )


@given(theta1=turn, theta2=arm_angle, theta3=turn)
def test_inverse_kinematics_recovers_joint_angles(theta1: float, theta2: float, theta3: float) -> None:
    q = np.array([theta1, theta2, theta3])
    found = inverse_kinematics(ROBOT, forward_kinematics(ROBOT, q))
    # theta1 comes back in (-pi, pi]; theta3 takes up the whole turns, for theta_t is not wrapped.
    assert found[1] == pytest.approx(theta2, abs=1e-11)
    assert wrapped(found[0] - theta1) == pytest.approx(0.0, abs=1e-11)
    assert wrapped(found[2] - theta3) == pytest.approx(0.0, abs=1e-11)
    assert np.sum(found) == pytest.approx(np.sum(q), abs=1e-11)


@given(distance=st.floats(NEAREST, FARTHEST), direction=turn, theta_t=turn)
def test_forward_kinematics_recovers_reachable_pose(
    distance: float, direction: float, theta_t: float
) -> None:
    pose = pose_with_wrist_at(distance, direction, theta_t)
    q = inverse_kinematics(ROBOT, pose)
    np.testing.assert_allclose(forward_kinematics(ROBOT, q), pose, rtol=0, atol=1e-7)
    assert -pi < q[0] <= pi
    assert pi <= q[1] <= 2 * pi
    if NEAREST + 1e-4 < distance < FARTHEST - 1e-4:
        np.testing.assert_allclose(forward_kinematics(ROBOT, q), pose, rtol=0, atol=1e-12)


beyond = st.one_of(st.floats(FARTHEST + 1e-6, 1e3), st.floats(0.0, NEAREST - 1e-6))


@given(distance=beyond, direction=turn, theta_t=turn)
def test_inverse_kinematics_unreachable_pose_raises(
    distance: float, direction: float, theta_t: float
) -> None:
    with pytest.raises(UnreachablePose):
        inverse_kinematics(ROBOT, pose_with_wrist_at(distance, direction, theta_t))


def test_unreachable_pose_error_names_pose_and_reach() -> None:
    with pytest.raises(UnreachablePose) as refusal:
        inverse_kinematics(ROBOT, [5.25, -1.5, 0.75])
    text = str(refusal.value)
    for part in ("5.25", "-1.5", "0.75", "0.31", "0.81"):
        assert part in text
    assert isinstance(refusal.value, ValueError)


@pytest.mark.parametrize("where", range(3))
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_inverse_kinematics_non_finite_pose_raises(where: int, bad: float) -> None:
    pose = forward_kinematics(ROBOT, [-1.0, 4.0, 5.5])
    pose[where] = bad
    with np.errstate(invalid="ignore"), pytest.raises(UnreachablePose):
        inverse_kinematics(ROBOT, pose)


def test_inverse_kinematics_batch_names_unreachable_pose() -> None:
    poses = forward_kinematics(ROBOT, np.tile([-1.0, 4.0, 5.5], (2, 3, 1)))
    poses[1, 2] = (7.125, 0.0, 0.0)
    with pytest.raises(UnreachablePose, match=r"7\.125"):
        inverse_kinematics(ROBOT, poses)


@pytest.mark.parametrize("shape", [(6,), (2, 3), (0,), (1, 1)])
def test_kinematics_batches_equal_single_calls(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(3)
    q = rng.uniform((-pi, pi + 0.1, pi), (pi, 2 * pi - 0.1, 2 * pi), (*shape, 3))
    poses = forward_kinematics(ROBOT, q)
    back = inverse_kinematics(ROBOT, poses)
    points = joint_positions(ROBOT, q)
    assert poses.shape == back.shape == q.shape
    assert points.shape == (*shape, 5, 2)
    for index in np.ndindex(*shape):
        np.testing.assert_allclose(poses[index], forward_kinematics(ROBOT, q[index]), rtol=0, atol=1e-15)
        np.testing.assert_allclose(back[index], inverse_kinematics(ROBOT, poses[index]), rtol=0, atol=1e-14)
        np.testing.assert_allclose(points[index], joint_positions(ROBOT, q[index]), rtol=0, atol=1e-15)


def test_forward_kinematics_address_matches_hand_value() -> None:
    """Link along the target line, arm and club straight down: a pose that needs no computer."""
    q = [0.0, 1.5 * pi, 2 * pi]
    expected = [0.25, -0.56 - 1.09, 3.5 * pi]
    np.testing.assert_allclose(forward_kinematics(ROBOT, q), expected, atol=1e-14)


@given(theta1=turn, theta2=turn, theta3=turn)
def test_joint_positions_keep_link_lengths(theta1: float, theta2: float, theta3: float) -> None:
    q = (theta1, theta2, theta3)
    r1, r2, r3, r6, head = joint_positions(ROBOT, q)
    rods = np.array([r2 - r1, r3 - r2, head - r3, r6 - r1, r2 - r6, r3 - r6])
    expected = [ROBOT.l12, ROBOT.l23, 1.09, ROBOT.l16, ROBOT.l62, float(right_arm_length(ROBOT, theta2))]
    np.testing.assert_allclose(np.linalg.norm(rods, axis=1), expected, rtol=1e-12)
    np.testing.assert_allclose(head, forward_kinematics(ROBOT, q)[:2], atol=1e-14)


@given(theta2=arm_angle)
def test_theta2_from_right_arm_inverts_right_arm_length(theta2: float) -> None:
    assert theta2_from_right_arm(ROBOT, right_arm_length(ROBOT, theta2)) == pytest.approx(theta2, abs=1e-11)


def test_right_arm_length_batch_matches_end_values() -> None:
    angles = np.linspace(pi, 2 * pi, 12).reshape(3, 4)
    lengths = right_arm_length(ROBOT, angles)
    assert lengths.shape == (3, 4)
    assert lengths[0, 0] == pytest.approx(ROBOT.l23 - ROBOT.l62)
    assert lengths[-1, -1] == pytest.approx(ROBOT.l23 + ROBOT.l62)
    assert np.all(np.diff(lengths.ravel()) > 0)
    np.testing.assert_allclose(theta2_from_right_arm(ROBOT, lengths), angles, atol=1e-7)


@pytest.mark.parametrize("length", [0.2, 0.95, np.nan, [0.5, 1.5]])
def test_theta2_from_right_arm_impossible_length_raises(length: Any) -> None:
    with pytest.raises(UnreachablePose, match=r"0\.22 to 0\.9 m"):
        theta2_from_right_arm(ROBOT, length)


@given(q=st.tuples(turn, turn, turn), u=st.tuples(*[st.floats(-30, 30)] * 3))
def test_head_motion_equals_pose_derivative(q: tuple[float, ...], u: tuple[float, ...]) -> None:
    motion: Any = head_motion
    found = np.array(motion(ROBOT.record[0], *q, *u))
    np.testing.assert_allclose(found[:3], forward_kinematics(ROBOT, q), atol=1e-14)
    h = 1e-6
    ahead, behind = (forward_kinematics(ROBOT, np.asarray(q) + sign * h * np.asarray(u)) for sign in (1, -1))
    np.testing.assert_allclose(found[3:], (ahead - behind) / (2 * h), atol=1e-4)
