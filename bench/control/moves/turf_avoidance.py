"""Valve commands that keep the head off the turf after an actuator fault near the ball.

A stop cuts the supply, or brakes with it. Over turf both may act too late: driving pressure digs the club in,
and braking pressure throws it back along the arc of a stretched arm, below the ground. So another actuator
acts for 0.03 s to 0.1 s:

- shoulder fault: the wrist's driving chamber exhausts, and the club stays back;
- arm fault: the shoulder's braking chamber exhausts, and does not throw the club back;
- wrist fault: the right arm pulls in, in addition to the brake.

PASSIVE still cuts the supply: chambers lose air, or receive the rest in the manifold. Openings and times were
found on the plant, `bench/manual/control/architecture.md`.
"""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase, Reaction
from drivers.base.compiled import compiled

OPENINGS = ((nan, 0.0, -0.4), (0.4, nan, 0.0), (0.0, -1.0, nan))
"""Openings of shoulder, arm and wrist, by the joint that does not obey; NaN: as the reaction sets it."""
TIMES = (0.03, 0.10, 0.06)
"""Duration from the start of the reaction, by that joint (s)."""


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
    """Set the desired openings that keep the head off the turf at `time` (s), and `turf_override`."""
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
