"""Ground clearance of the head: the order of a slow move, a head that rests low, and faults near the ball.

Slow moves: with all joints together the head passes below the line between both ends, and lower still where
dry friction holds the arm back for a while. Where that comes too near to the ground, arm and wrist go before
the shoulder if that lifts the head.

A head that rests nearer to the ground than the robot may move may be lifted, but not come nearer: a vented
robot sinks until friction, or the ground, holds it. Otherwise it could not be armed from there.

Faults near the ball: a stop cuts the supply, or brakes with it. Over turf both may act too late: driving
pressure digs the club in, and braking pressure throws it back along the arc of a stretched arm, below the
ground. So another actuator acts for 0.03 s to 0.1 s:

- shoulder fault: the wrist's driving chamber exhausts, and the club stays back;
- arm fault: the shoulder's braking chamber exhausts, and does not throw the club back;
- wrist fault: the right arm pulls in, in addition to the brake.

PASSIVE still cuts the supply: chambers lose air, or receive the rest in the manifold. Valve commands and
times were found on the plant, `bench/manual/control/architecture.md`.
"""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase, Reaction, State
from bench.control.envelope import spare_clearance
from drivers.base.compiled import compiled
from sim.kinematics import head_motion

OPENINGS = ((nan, 0.0, -0.4), (0.4, nan, 0.0), (0.0, -1.0, nan))
"""Valve commands of shoulder, arm and wrist, by the faulty joint; NaN: as the reaction sets it."""
TIMES = (0.03, 0.10, 0.06)
"""Duration from the start of the reaction, by that joint (s)."""
_SLACK = 0.001
"""Max sinking while the air comes in (m)."""
_SHOULDER = 0
"""Index of the shoulder in drivers.base.JOINTS."""
_MIN_MARGIN = 0.030
"""Sufficient height over the required clearance (m): an arm that sticks until its PID moves it costs 23
mm."""
_MIN_IMPROVEMENT = 0.001
"""Required gain in ground clearance to change the order (m)."""
_POSES = 24
"""Number of poses checked on a path."""


@compiled
def moves_arm_first(parameters: Any, start: Any, end: Any) -> bool:
    """Return whether arm and wrist go before the shoulder on the way from `start` to `end`, (3,) rad."""
    together = _spare(parameters, start, end, False)
    if together >= _MIN_MARGIN:
        return False
    return bool(_spare(parameters, start, end, True) > together + _MIN_IMPROVEMENT)


@compiled
def joint_progress(part: float, joint: int, first: bool) -> float:
    """Return the progress (0 to 1) of `joint` at `part` of the move.

    With `first`, arm and wrist use the first half and the shoulder the second.
    """
    if not first:
        return part
    own = 2.0 * part - 1.0 if joint == _SHOULDER else 2.0 * part
    return min(max(own, 0.0), 1.0)


@compiled
def _spare(parameters: Any, start: Any, end: Any, first: bool) -> float:
    """Return the min spare clearance (m) of the head on its path; negative where it is too low."""
    p, robot = parameters.envelope[0], parameters.robot[0]
    least = 10.0
    for k in range(_POSES + 1):
        # Scalars, as the step allocates nothing.
        shoulder = start[0] + (end[0] - start[0]) * joint_progress(k / _POSES, 0, first)
        arm = start[1] + (end[1] - start[1]) * joint_progress(k / _POSES, 1, first)
        wrist = start[2] + (end[2] - start[2]) * joint_progress(k / _POSES, 2, first)
        head = head_motion(robot, shoulder, arm, wrist, 0.0, 0.0, 0.0)
        least = min(least, spare_clearance(p, head[0], head[1]))
    return least


@compiled
def monitor_low_head(s: Any, envelope: Any, time: float) -> float:
    """Return the reduction of the required clearance (m) in this tick, for a head that rested low.

    It applies only on the way to the address after arming. With the air on it only falls, as the head rises.
    """
    p = envelope[0]
    if not (s.state == State.ARMED and s.phase == Phase.RETURN):
        s.clearance_relief = 0.0
        return 0.0
    missing = max(_SLACK - spare_clearance(p, s.head[0], s.head[1]), 0.0)
    if time <= s.air_from or missing < s.clearance_relief:
        s.clearance_relief = missing
    return float(s.clearance_relief)


@compiled
def disobeying(cause: int) -> int:
    """Return the joint whose valve, or air, does not obey, by `cause`; -1 if it is another."""
    encoder = Cause.SHOULDER_JUMP <= cause <= Cause.WRIST_EFFORT
    if Cause.SHOULDER_AIR <= cause <= Cause.WRIST_FLOW and not encoder:
        return int(cause - Cause.SHOULDER_AIR) % 3
    if Cause.SHOULDER_SENSOR <= cause <= Cause.WRIST_SENSOR:
        return int(cause - Cause.SHOULDER_SENSOR)
    if Cause.SHOULDER_SPOOL <= cause <= Cause.WRIST_SPOOL:
        return int(cause - Cause.SHOULDER_SPOOL)
    return -1


@compiled
def escape(s: Any, p: Any, time: float) -> None:
    """Set the desired valve commands that keep the head off the turf at `time` (s), and `turf_override`."""
    for i in range(3):
        s.turf_override[i] = 0
    joint = disobeying(s.latest_cause)
    stopping = s.reaction in (Reaction.BRAKE, Reaction.PASSIVE)
    around_ball = Phase.DOWNSWING <= s.phase <= Phase.FOLLOW_THROUGH
    if joint < 0 or not (stopping and around_ball and time - s.reaction_start < p.escape_time[joint]):
        return
    for i in range(3):
        if np.isfinite(p.escape_opening[joint, i]):
            s.desired[i], s.turf_override[i] = p.escape_opening[joint, i], 1
