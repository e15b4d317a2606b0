"""Valves are hardly open until each joint has answered."""

from __future__ import annotations

from math import inf, isnan, nan
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase
from bench.control.estimate.estimator import ESTIMATOR_STATE
from bench.control.law.pid import PID_STATE
from bench.control.moves.first_motion import (
    bound_first,
    centre_unanswered,
    first_motion_cause,
    forget_answers,
    note_answers,
)
from bench.control.step_records import CONTROL_PARAMETERS, CONTROL_STATE
from drivers.base.compiled import new_record

BAND, OPENING = 0.02, 0.15


class Joints:
    """Records of a bench that is homed with joint 1 alone in motion."""

    def __init__(self) -> None:
        self.state, self.pid = new_record(CONTROL_STATE), new_record(PID_STATE)
        self.estimator, self.parameters = new_record(ESTIMATOR_STATE), new_record(CONTROL_PARAMETERS)
        self.state["phase"], self.state["measured_step"] = Phase.HOMING, 0.1
        self.parameters["move_band"], self.parameters["home_opening"] = BAND, OPENING
        self.parameters["home_stop_contact_speed"] = 0.5

    def tick(self, reference_speed: float, angle: float) -> None:
        self.state["reference_velocity"][0, 1] = reference_speed
        self.estimator["angle"][0, 1] = angle
        note_answers(self.state[0], self.pid[0], self.estimator[0])

    def bound(self, opening: float, joint: int = 1) -> float:
        return float(bound_first(self.state[0], self.parameters[0], joint, opening))

    @property
    def answered(self) -> list[int]:
        return [int(joint) for joint in self.state["first_motion"]["answered"][0]]


@pytest.fixture
def joints() -> Joints:
    return Joints()


def test_bound_first_before_motion_slightly_exceeds_dead_band(joints: Joints) -> None:
    joints.tick(0.0, 1.0)
    assert joints.bound(1.0) == pytest.approx(BAND + 0.005)
    assert joints.bound(-1.0) == pytest.approx(-BAND - 0.005)
    assert joints.bound(0.01) == 0.01
    assert isnan(joints.bound(nan))


def test_bound_first_unanswered_joint_grows(joints: Joints) -> None:
    for _ in range(12):
        joints.tick(0.2, 1.0)
    joints.tick(0.0, 1.0)  # the reference waits
    assert joints.bound(1.0) == pytest.approx(BAND + 0.005 + 13 * 0.002)
    assert joints.bound(1.0, joint=0) == pytest.approx(BAND + 0.005)
    assert joints.answered == [0, 0, 0]


def test_note_answers_motion_with_reference_releases_bound_gradually(joints: Joints) -> None:
    joints.pid["integral"][0] = 0.3
    joints.tick(-0.2, 1.0)
    joints.tick(-0.2, 0.96)
    assert joints.answered == [0, 0, 0]
    joints.tick(-0.2, 0.94)
    assert joints.answered == [0, 1, 0]
    assert joints.pid["integral"][0].tolist() == [0.3, 0.0, 0.3]
    assert joints.bound(1.0) < 0.05
    while joints.state["first_motion"]["bound"][0, 1] < OPENING:
        joints.tick(-0.2, 0.9)
    assert joints.bound(1.0) == 1.0


def test_note_answers_motion_against_reference_does_not_count(joints: Joints) -> None:
    for angle in (1.0, 1.1, 1.5):
        joints.tick(-0.2, angle)
    assert joints.answered == [0, 0, 0]
    joints.tick(0.2, 1.5)  # turned round: counted from here
    joints.tick(0.2, 1.54)
    assert joints.answered == [0, 0, 0]
    joints.tick(0.2, 1.56)
    assert joints.answered == [0, 1, 0]


def test_note_answers_zero_shift_does_not_count(joints: Joints) -> None:
    joints.tick(0.2, 1.0)
    joints.state["homing"]["zero_shift"][0, 1] = 2.0
    joints.tick(0.2, 3.01)
    assert joints.answered == [0, 0, 0]


def test_bound_first_backward_clock_does_not_grow(joints: Joints) -> None:
    joints.state["measured_step"] = -1.0
    joints.tick(0.2, 1.0)
    assert joints.state["first_motion"]["bound"][0, 1] == 0.0


def test_bound_first_outside_slow_moves_passes_opening(joints: Joints) -> None:
    joints.state["phase"] = Phase.HOLD
    assert joints.bound(1.0) == 1.0
    joints.state["moving"] = True
    assert joints.bound(1.0) == pytest.approx(BAND + 0.005)


def test_forget_answers_resets_answers_and_bound(joints: Joints) -> None:
    for name in ("answered", "way", "bound"):
        joints.state["first_motion"][name] = 1
    forget_answers(joints.state[0])
    assert joints.answered == [0, 0, 0]
    assert joints.bound(1.0) == pytest.approx(BAND + 0.005)


@pytest.mark.parametrize(("speed", "way"), [(1.51, 1.0), (-1.51, -1.0), (1.91, 0.0), (nan, 0.0), (inf, 1.0)])
def test_first_motion_cause_fast_unanswered_joint_reports_following(
    joints: Joints, speed: float, way: float
) -> None:
    joints.state["first_motion"]["way"][0, 2] = way
    velocity = np.array([1.4, 0.0, speed])
    cause: Any = first_motion_cause(joints.state[0], joints.parameters[0], velocity)
    assert cause == Cause.WRIST_FOLLOWING
    joints.state["first_motion"]["answered"][0, 2] = 1
    assert first_motion_cause(joints.state[0], joints.parameters[0], velocity) == 0


@pytest.mark.parametrize(
    ("phase", "left"),
    [
        (Phase.HOMING, 0.0),
        (Phase.RETURN, 0.0),
        (Phase.HOLD, 0.0),
        (Phase.BACKSWING, 0.5),
        (Phase.DOWNSWING, 0.5),
    ],
)
def test_centre_unanswered_in_slow_move_closes_valve(joints: Joints, phase: Phase, left: float) -> None:
    joints.state["phase"], joints.state["desired"] = phase, 0.5
    joints.state["first_motion"]["answered"][0, 1] = 1
    centre_unanswered(joints.state[0])
    assert joints.state["desired"][0].tolist() == [left, 0.5, left]
