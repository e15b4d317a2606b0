"""A head that rests nearer to the ground than the robot may move: it may be lifted, but not come nearer.

A vented robot sinks until friction, or the ground, holds it. Otherwise it could not be armed from there.
"""

from __future__ import annotations

from typing import Any

from bench.base.lifecycle import Phase, State
from bench.control.envelope import spare_clearance
from drivers.base.compiled import compiled

_SLACK = 0.001
"""Max sinking while the air comes in (m)."""


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
