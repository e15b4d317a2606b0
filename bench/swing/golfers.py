"""Golfers, their downswing as a model, and how far a robot's swing is from it.

Hunt's functions (`bench.swing.hunt`) are a 2-handicap's. His downswing gives shoulder and right arm; the
wrist is free, so that its angle is the torque-free response of the club, within the human wrist's range.
The other golfers are Hunt's, scaled in time to their tempo and in amplitude until the head has their speed
where it passes the ball: no joint angles of theirs are public. Past their end the functions go on, the
shoulder at its speed and the right arm at its length, until the head is there.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError, did_you_mean
from bench.swing.hunt import (
    BACKSWING_DURATION,
    DOWNSWING_DURATION,
    DOWNSWING_TURN,
    right_arm_length,
    shoulder_turn,
)
from drivers.base.compiled import compiled
from sim.kane import kane_terms
from sim.kinematics import forward_kinematics, theta2_from_right_arm
from sim.plant import PlantParameters

Array = NDArray[np.float64]

_MPH = 0.44704
_STEP = 2.5e-4
_LONGEST = 1.6
"""How far past their end the functions go on, in downswings."""
_ADDRESS = 0.45, 0.2125
"""theta1 (rad) and rod extension (m) at address: his right arm's range in the middle of the thesis' robot."""
_THESIS_ARM = 0.34
"""Length of that robot's right arm at no extension, m: other robots do not change the golfer's arms."""
_COCK_AT_TOP = 1.769
_WRIST = 2 * np.pi - radians(105.0), 2 * np.pi + radians(5.0)
"""Range of the human wrist (thesis), as theta3."""
_RIGHT_ARM_AT_ADDRESS = -0.03032
_AMPLITUDES = [0.5 + 0.01 * k for k in range(131)]
"""That are tried, in this order."""


@dataclass(frozen=True)
class Golfer:
    """Who swings: the head speed at the ball and the tempo; sources in `text`."""

    name: str
    text: str
    head_speed: float
    """m/s"""
    backswing: float
    """s"""
    downswing: float
    """s"""
    as_given: bool = False
    """Hunt's functions without scaling."""


def _golfer(name: str, text: str, mph: float, backswing: float, downswing: float) -> Golfer:
    return Golfer(name, f"{text}; Hunt's motion, scaled", mph * _MPH, backswing, downswing)


GOLFERS = {
    golfer.name: golfer
    for golfer in (
        _golfer("tour-male", "average of the PGA Tour, 115 mph", 115, 0.80, 0.233),
        _golfer("tour-female", "average of the LPGA Tour, 96 mph", 96, 1.03, 0.267),
        Golfer(
            "two-handicap",
            "the thesis' golfer: Hunt's functions as given, over 100 mph",
            105 * _MPH,
            BACKSWING_DURATION,
            DOWNSWING_DURATION,
            as_given=True,
        ),
        _golfer("average-male", "USGA's average male, 93 mph", 93, 0.85, 0.26),
        _golfer("average-female", "USGA's average female, 72-79 mph", 75, 1.1, 0.30),
        _golfer("senior", "over 60 years, 80-90 mph", 82, 1.0, 0.30),
    )
}


def find_golfer(name: str) -> Golfer:
    """Return the golfer with `name`.

    Raises:
        BenchError: the name is unknown; the text lists the known ones.
    """
    if name in GOLFERS:
        return GOLFERS[name]
    cure = did_you_mean(name, GOLFERS, "`golfbench golfer compare` shows them.")
    raise BenchError(f"golfer {name}", "no such golfer", f"one of {', '.join(GOLFERS)}", cure)


class HumanDownswing(NamedTuple):
    """The model's downswing in the robot's coordinates, from the top until the head passes the ball."""

    time: Array
    """(n,) s"""
    angle: Array
    """(n, 3) rad"""
    head: Array
    """(n, 2) m"""
    head_speed: float
    """m/s at its end."""
    amplitude: float
    """Of Hunt's functions."""
    reaches: bool
    """Whether the head passes the ball's place."""


@compiled
def free_wrist(
    robot: NDArray[np.void], angle: Array, speed: Array, bend: Array, low: float, high: float, step: float
) -> None:
    """Fill the third columns of `angle` and `speed` (n, 3): the wrist without torque between its stops.

    `bend` (n,) is theta2's acceleration; theta1's is zero. Stops are plastic. Starts from row 0.
    """
    r = robot[0]
    for k in range(len(angle) - 1):
        q, u = angle[k], speed[k]
        _, _, _, _, m23, m33, _, _, h3, _ = kane_terms(r, q[0], q[1], q[2], u[0], u[1], u[2])
        rate = u[2] + step * (-h3 - m23 * bend[k]) / m33
        turn = q[2] + step * rate
        if turn < low:
            turn, rate = low, max(rate, 0.0)
        elif turn > high:
            turn, rate = high, min(rate, 0.0)
        angle[k + 1, 2], speed[k + 1, 2] = turn, rate


def human_downswing(plant: PlantParameters, golfer: Golfer) -> HumanDownswing:
    """Return the downswing of `golfer`, with the smallest amplitude that reaches the speed at the ball.

    With more than some amplitude the wrist meets its stop before the ball, and the head is slow again. Where
    that comes first, the fastest downswing is returned; its `head_speed` says so.
    """
    if golfer.as_given:
        return _downswing(plant, golfer, 1.0)
    slower = fastest = _downswing(plant, golfer, _AMPLITUDES[0])
    for amplitude in _AMPLITUDES[1:]:
        tried = _downswing(plant, golfer, amplitude)
        if tried.reaches and tried.head_speed >= golfer.head_speed:
            return _bisected(plant, golfer, slower.amplitude, tried.amplitude)
        slower = tried
        if tried.reaches and tried.head_speed > fastest.head_speed:
            fastest = tried
    return fastest


def _bisected(plant: PlantParameters, golfer: Golfer, low: float, high: float) -> HumanDownswing:
    for _ in range(18):
        middle = (low + high) / 2
        found = _downswing(plant, golfer, middle)
        fast = found.reaches and found.head_speed > golfer.head_speed
        low, high = (low, middle) if fast else (middle, high)
    return _downswing(plant, golfer, high)


def _downswing(plant: PlantParameters, golfer: Golfer, amplitude: float) -> HumanDownswing:
    robot, scale = plant.robot, DOWNSWING_DURATION / golfer.downswing
    time: Array = np.arange(round(_LONGEST * golfer.downswing / _STEP), dtype=float) * _STEP
    own = BACKSWING_DURATION + np.minimum(time * scale, DOWNSWING_DURATION)
    past = np.maximum(time * scale - DOWNSWING_DURATION, 0.0)
    extension = _ADDRESS[1] + amplitude * (right_arm_length(own) - _RIGHT_ARM_AT_ADDRESS)
    angle, speed = np.zeros((len(time), 3)), np.zeros((len(time), 3))
    angle[:, 0] = _ADDRESS[0] - amplitude * (shoulder_turn(own) - DOWNSWING_TURN * past)
    # The linkage ends before the longest amplitude does.
    angle[:, 1] = theta2_from_right_arm(robot, np.clip(_THESIS_ARM + extension, 0.25, 0.85))
    speed[:, 0] = amplitude * DOWNSWING_TURN * scale
    speed[:, 1] = np.gradient(angle[:, 1], _STEP)
    angle[0, 2] = max(2 * np.pi - amplitude * _COCK_AT_TOP, _WRIST[0])
    free_wrist(robot.record, angle, speed, np.gradient(speed[:, 1], _STEP), *_WRIST, _STEP)
    pose = forward_kinematics(robot, angle)
    passing = np.flatnonzero(
        (np.diff(pose[:, 0] >= plant.site.ball_x)) & (pose[1:, 1] < -0.9) & (pose[1:, 0] > pose[:-1, 0])
    )
    end = int(passing[0]) + 1 if len(passing) else len(time) - 1
    velocity = (pose[end, :2] - pose[end - 1, :2]) / _STEP
    rows = slice(0, end + 1)
    return HumanDownswing(
        time[rows], angle[rows], pose[rows, :2], float(np.hypot(*velocity)), amplitude, bool(len(passing))
    )
