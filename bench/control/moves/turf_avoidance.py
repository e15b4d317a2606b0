"""Openings that keep the head off the turf where an actuator does not obey around the ball.

A stop takes the air away, or brakes with it. Over turf both may come too late: what drives the club on digs
it in, and what braked it throws it back along the arc of a stretched arm, which lies below the ground. So one
of the other actuators acts for a few hundredths of a second:

- the shoulder does not obey: the wrist's driving chamber is let off, and the club stays back;
- the arm does not obey: the shoulder's braking chamber is let off, and does not throw the club back;
- the wrist does not obey: the right arm pulls in, beside the brake.

With PASSIVE the supply is cut as ever: chambers lose air, and get what the manifold still has. Openings
and times were found on the plant, `bench/manual/control/architecture.md`.
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
"""s from the begin of the reaction, by that joint."""


@compiled
def disobeying(cause: int) -> int:
    """Return the joint whose air does not follow its valve, by `cause`; -1 if it is another."""
    encoder = Cause.SHOULDER_JUMP <= cause <= Cause.WRIST_EFFORT
    if Cause.SHOULDER_AIR <= cause <= Cause.WRIST_FLOW and not encoder:
        return int(cause - Cause.SHOULDER_AIR) % 3
    if Cause.SHOULDER_SENSOR <= cause <= Cause.WRIST_SENSOR:
        return int(cause - Cause.SHOULDER_SENSOR)
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
