"""Built-in golfers and their downswing as a model.

Measured golfers differ in speed more than in motion: they begin at rest, the faster ones turn faster and not
further, and the wrist stays cocked until late. A golfer is therefore the measured motion in the time that
gives his or her head speed on the robot's arms. `MEASURED` is the mean of two persons' downswings, one with a
driver (360 Hz) and three with an iron (240 Hz), clocks scaled from the top to the ball, rounded to 1 degree;
shoulders and arms as `bench.golfer` measures them. Assumed: that other golfers of either sex and any age move
alike. Head speed and backswing have the sources in `text`.

The two-handicap golfer is the thesis': Hunt's functions as given for shoulder and right arm. The wrist is
free, so that its angle is the torque-free response of the club, within the human wrist's range. Past its end
each motion continues at its last speed until the head passes the ball.

Source of Hunt's functions: E. A. Hunt (2002, 2003), quoted in tables 1 and 2 of the thesis (Meymi, "Modeling
and control of parallel arm golfing robot", KTH 2009). They are as printed: in the backswing a turn of 2.639
rad/s and a displacement of -0.03032 m + STEP(t, 0.2, 0, 0.686, -0.2035), in the downswing 11.8028 rad/s and
-0.23382 m + STEP(t, 0, 0, 0.1667, 0.2035). STEP is ADAMS' cubic smooth step, not the tanh the thesis takes it
for. The turn counts from address and is positive in the backswing: a robot that follows it has theta1 =
theta1 at address - turn. Table 2 starts it at zero again, so the whole swing adds the turn at the top. The
right arm's displacement counts from Hunt's zero (unpublished), negative is shorter.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from bench.base.errors import BenchError, did_you_mean
from drivers.base.compiled import compiled
from sim.kane import kane_terms
from sim.kinematics import forward_kinematics, theta2_from_right_arm
from sim.plant import PlantParameters

Array = NDArray[np.float64]

BACKSWING_DURATION, DOWNSWING_DURATION = 0.686, 0.1667
"""Durations in Hunt's functions (s)."""
DOWNSWING_TURN = 11.8028
"""Speed of Hunt's shoulder in the downswing (rad/s)."""

_MPH = 0.44704
_STEP = 2.5e-4
_MAX_LENGTH = 1.6
"""Length of a motion with its continuation past the end, in downswings."""
_STEPS = 1000
"""Rows of a measured downswing."""
_ADDRESS = 0.45, 0.2125
"""theta1 (rad) and rod extension (m) at address: his right arm's range in the middle of the thesis' robot."""
_THESIS_ARM = 0.34
"""Length of that robot's right arm at no extension, m: other robots do not change the golfer's arms."""
_COCK_AT_TOP = 1.769
_WRIST = 2 * np.pi - radians(105.0), 2 * np.pi + radians(5.0)
"""Range of the human wrist (thesis), as theta3."""
_RIGHT_ARM_AT_ADDRESS = -0.03032
_MIN_HEIGHT_AT_BALL = -0.9
"""Height y (m) above which a crossing of the ball's x does not count: the head crosses it again over the
shoulder."""

MEASURED = (
    (-93, -92, -89, -84, -77, -68, -56, -43, -29, -15, -1, 13, 27),
    (215, 214, 214, 214, 214, 215, 217, 221, 229, 238, 246, 250, 252),
    (243, 242, 242, 241, 241, 241, 242, 244, 249, 261, 282, 312, 348),
)
"""theta1, theta2 and theta3 (degrees) from the top to the ball, at equal intervals."""


@dataclass(frozen=True)
class Golfer:
    """A golfer by head speed at the ball and tempo; sources in `text`."""

    name: str
    text: str
    head_speed: float
    """Head speed (m/s)."""
    backswing: float
    """Duration of the backswing (s)."""
    as_hunt: bool = False
    """Hunt's published functions, not scaled to a head speed."""


def _golfer(name: str, text: str, mph: float, backswing: float) -> Golfer:
    return Golfer(name, f"{text}; measured motion at that speed", mph * _MPH, backswing)


GOLFERS = {
    golfer.name: golfer
    for golfer in (
        _golfer("tour-male", "average of the PGA Tour, 115 mph", 115, 0.80),
        _golfer("tour-female", "average of the LPGA Tour, 96 mph", 96, 1.03),
        Golfer(
            "two-handicap",
            "the thesis' golfer: Hunt's functions as given, over 100 mph",
            105 * _MPH,
            BACKSWING_DURATION,
            as_hunt=True,
        ),
        _golfer("average-male", "USGA's average male, 93 mph", 93, 0.85),
        _golfer("average-female", "USGA's average female, 72-79 mph", 75, 1.1),
        _golfer("senior", "over 60 years, 80-90 mph", 82, 1.0),
    )
}


def find_golfer(name: str) -> Golfer:
    """Return the golfer with `name`.

    Raises:
        BenchError: the name is unknown; the text lists the known ones.
    """
    if name in GOLFERS:
        return GOLFERS[name]
    action = did_you_mean(name, GOLFERS, "`golfbench golfer compare` shows them.")
    raise BenchError(f"golfer {name}", "no such golfer", f"one of {', '.join(GOLFERS)}", action)


class HumanDownswing(NamedTuple):
    """The model's downswing in the robot's coordinates, from the top until the head passes the ball."""

    time: Array
    """(n,) s"""
    angle: Array
    """(n, 3) rad"""
    head: Array
    """(n, 2) m"""
    head_speed: float
    """Head speed at its end (m/s)."""


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
    """Return the downswing of `golfer` until the head passes the ball's place on the site of `plant`.

    Raises:
        BenchError: the head does not come there.
    """
    time, angle = _hunts_motion(plant) if golfer.as_hunt else _measured_motion()
    pose = forward_kinematics(plant.robot, angle)
    passing = np.flatnonzero(
        np.diff(pose[:, 0] >= plant.site.ball_x)
        & (pose[1:, 1] < _MIN_HEIGHT_AT_BALL)
        & (pose[1:, 0] > pose[:-1, 0])
    )
    if not len(passing):
        raise BenchError(
            f"golfer {golfer.name}",
            f"a head that does not come to a ball at x = {plant.site.ball_x:g} m",
            "a ball within the golfer's reach",
            "Set [plant.site] ball_x nearer to the shoulder, or design with --speed and without --golfer.",
        )
    end = int(passing[0]) + 1
    speed = float(np.hypot(*((pose[end, :2] - pose[end - 1, :2]) / (time[end] - time[end - 1]))))
    if not golfer.as_hunt:
        time, speed = time * (speed / golfer.head_speed), golfer.head_speed
    return HumanDownswing(time[: end + 1], angle[: end + 1], pose[: end + 1, :2], speed)


def _measured_motion() -> tuple[Array, Array]:
    """Return time (n,), 1 s from the top to the ball, and angles (n, 3; rad) of the measured downswing."""
    degrees = np.array(MEASURED, dtype=float).T
    spline = CubicSpline(np.linspace(0.0, 1.0, len(degrees)), degrees, bc_type=("clamped", "not-a-knot"))
    time: Array = np.arange(round(_MAX_LENGTH * _STEPS), dtype=float) / _STEPS
    past = np.maximum(time - 1.0, 0.0)[:, None]
    return time, np.radians(spline(np.minimum(time, 1.0)) + spline(1.0, 1) * past)


def _hunts_motion(plant: PlantParameters) -> tuple[Array, Array]:
    """Return time (n,; s) and angles (n, 3; rad) of Hunt's downswing, with a free wrist."""
    robot = plant.robot
    time: Array = np.arange(round(_MAX_LENGTH * DOWNSWING_DURATION / _STEP), dtype=float) * _STEP
    # His clock starts with the backswing.
    down = (BACKSWING_DURATION + np.minimum(time, DOWNSWING_DURATION)) - BACKSWING_DURATION
    past = np.maximum(time - DOWNSWING_DURATION, 0.0)
    share = np.clip(down / DOWNSWING_DURATION, 0.0, 1.0)
    displacement = 0.2035 * share**2 * (3.0 - 2.0 * share) - 0.23382
    extension = _ADDRESS[1] + displacement - _RIGHT_ARM_AT_ADDRESS
    turn = 2.639 * BACKSWING_DURATION - DOWNSWING_TURN * down
    angle, speed = np.zeros((len(time), 3)), np.zeros((len(time), 3))
    angle[:, 0] = _ADDRESS[0] - turn + DOWNSWING_TURN * past
    angle[:, 1] = theta2_from_right_arm(robot, _THESIS_ARM + extension)
    speed[:, 0] = DOWNSWING_TURN
    speed[:, 1] = np.gradient(angle[:, 1], _STEP)
    angle[0, 2] = max(2 * np.pi - _COCK_AT_TOP, _WRIST[0])
    free_wrist(robot.record, angle, speed, np.gradient(speed[:, 1], _STEP), *_WRIST, _STEP)
    return time, angle
