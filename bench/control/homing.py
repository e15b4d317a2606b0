"""Homing by index search: one joint after the other is turned slowly until its encoder's index has passed.

Until then an incremental encoder counts from where it was switched on, so that only differences of its angles
mean anything: working range, ground and frame are not known, and the search is bounded by travel, time, speed
and following error instead. The encoder itself sets its count to zero at the index; the angle, from there on
the joint's, is taken over without a jump of the velocity (`bench.control.step.estimate_tick`).

No output of the bench lowers the supply's pressure. The openings of the valves are bounded instead, which
bounds the flow and so the speed at which a joint can move, not the force at which it presses against what is
in its way; the following error ends that.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.lifecycle import Cause
from drivers.base.compiled import compiled

RAMP = 0.3
"""s from rest to the search's speed."""

_FASTER = 12.0
"""Times the search's speed that are too fast; a joint that breaks loose from dry friction jerks."""


@compiled
def begin_search(s: Any, p: Any, angle: Any, time: float) -> None:
    """Begin to search at `time` (s): set-point := measured, for all joints."""
    s.home_turn, s.home_since = 0, time
    for i in range(3):
        s.reference[i] = s.home_from[i] = angle[i]
        s.reference_velocity[i] = s.reference_acceleration[i] = s.feed_forward[i] = 0.0


@compiled
def search(s: Any, p: Any, angle: Any, indexed: Any, shifted: Any, time: float, measured_step: float) -> bool:
    """Move the references (rad) of the search on; return True once all joints are `indexed`.

    `angle` (3,) rad is estimated, `shifted` (3,) rad is what the zero set in this tick added to it.
    """
    for i in range(3):
        s.reference[i] += shifted[i]
        s.home_from[i] += shifted[i]
        s.reference_velocity[i] = s.reference_acceleration[i] = s.feed_forward[i] = 0.0
    while s.home_turn < 3 and indexed[p.home_order[s.home_turn]] != 0:
        joint = p.home_order[s.home_turn]
        s.reference[joint] = angle[joint]
        s.home_turn, s.home_since = s.home_turn + 1, time
        if s.home_turn < 3:
            following = p.home_order[s.home_turn]
            s.home_from[following] = angle[following]
    if s.home_turn >= 3:
        return True
    if time > s.home_since and measured_step > 0.0:
        joint = p.home_order[s.home_turn]
        speed = p.home_direction[joint] * p.home_speed[joint] * min((time - s.home_since) / RAMP, 1.0)
        s.reference[joint] += speed * measured_step
        s.reference_velocity[joint] = speed
        s.feed_forward[joint] = p.move_gain[joint] * speed
    return False


@compiled
def bounded(p: Any, opening: float) -> float:
    """Return `opening` within what the search allows; NaN stays NaN, for the envelope."""
    return min(max(opening, -p.home_opening), p.home_opening) if np.isfinite(opening) else opening


@compiled
def search_cause(
    s: Any, p: Any, following: Any, max_gap: float, angle: Any, velocity: Any, time: float
) -> int:
    """Return the cause that ends the search, or 0; `following` (3,) rad is the max following error.

    A joint that does not follow its reference has its own cause: it, or its valve, may be stuck.
    """
    if not 0.0 <= s.measured_step <= max_gap:
        return Cause.TICK_GAP
    if not time - s.home_begin <= p.home_longest:
        return Cause.HOMING_FAILED
    for i in range(3):
        if not abs(s.reference[i] - angle[i]) <= following[i]:
            return Cause.SHOULDER_FOLLOWING + i
        if not abs(velocity[i]) <= _FASTER * p.home_speed[i]:
            return Cause.HOMING_FAILED
        if not abs(angle[i] - s.home_from[i]) <= p.home_travel[i]:
            return Cause.HOMING_FAILED
    return 0
