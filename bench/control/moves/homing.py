"""Homing: one joint after the other is turned until its encoder's index has passed, then to its end stop.

The index says where the encoder is, not where the joint is: a coupling that slipped or a mark that moved is
found at the stop, which no encoder knows of. Each joint has to come to rest there, pressed by its air, at the
angle that the robot's geometry says. Then all go back to where they came from. Absolute encoders are proven
in the same way. An index is searched for in each homing: `Command.search_index` makes the device forget it. A
joint that already is beyond it turns round, where it comes to its stop or has gone as far as it may.

Until its index has passed an incremental encoder counts from where it was switched on, so that only
differences of its angles mean anything: working range, ground and frame are not known, and the search is
bounded by travel, time, speed and following error instead. The encoder itself sets its count to zero at the
index; the angle, from there on the joint's, is taken over without a jump of the velocity
(`bench.control.step.estimate_tick`).

No output of the bench lowers the supply's pressure. The valve commands are bounded instead. This
bounds the flow and so the speed at which a joint can move, not the force at which it presses against an
obstacle; the following error ends that.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase
from bench.control.law.pid import reset_integral
from bench.control.moves.first_motion import is_free
from bench.control.moves.references import direction
from drivers.base.compiled import compiled

RAMP = 0.3
"""Time from rest to the speed of the search (s)."""

_FIRM = 0.8
"""Fraction of the lead at which a joint counts as pressed."""
_RESTS = 0.005
"""Max movement of a resting joint (rad)."""
_PRESSED = 0.001
"""Range (rad) of a joint that is pressed against its stop: its air still pushes one that creeps into it."""
_OVERSHOOT = 0.03
"""Angle beyond the pressed stop (rad) that the impact on its spring may reach, before it rests."""
_BEYOND = 0.1
"""Angle beyond the travel in which a searching joint comes to rest before it turns round (rad)."""
_EASE = 0.4
"""Fraction of the lead that pulls a joint off its stop: a full chamber throws a lagging joint harder."""
_LEASH = 1.5
"""Max lead, as a multiple of `stop_contact_lead`, while filling chambers push a joint. The search then starts
at its angle: drawn back, it would be thrown, and the wrist would swing faster than homing allows."""
_PUSH_TIMEOUT = 2.0
"""Max time for which a joint rests against its reference elsewhere (s): dry friction holds it as long as the
air takes to change sides."""
_FASTER = 12.0
"""Times the search's speed that are too fast; a joint that breaks loose from dry friction jerks."""


@compiled
def begin_search(state: Any, p: Any, now: float) -> None:
    """Warn from `now` (s) on, charge, then search: set-point := measured, for all joints."""
    s, angle = state.control[0], state.estimator[0].angle
    h = s.homing
    reset_integral(state.pid)
    s.disarming = s.tee = False
    s.air_from = now + p.warning_time
    s.move.start = h.began = time = s.air_from + p.precharge_time
    s.phase = Phase.HOMING
    h.turn, h.since, h.pushed_since = 0, time, time
    h.touching, h.way = not p.home_by_index, 1.0
    for i in range(3):
        s.reference[i] = h.start[i] = h.origin[i] = angle[i]
        s.reference_velocity[i] = s.reference_acceleration[i] = s.feed_forward[i] = 0.0
        h.free[i] = not p.home_by_index


@compiled
def search(s: Any, p: Any, e: Any, d: Any, indexed: Any, time: float, measured_step: float) -> bool:
    """Move the references (rad) on; return True once all joints are `indexed` and have been at their stops.

    `e` is ESTIMATOR_STATE, `d` PID_STATE.
    """
    h = s.homing
    for i in range(3):
        # A zero that was set in this tick: the joint's motion is unchanged.
        s.reference[i] += h.zero_shift[i]
        h.start[i] += h.zero_shift[i]
        h.origin[i] += h.zero_shift[i]
        s.reference_velocity[i] = s.reference_acceleration[i] = s.feed_forward[i] = 0.0
        if indexed[i] == 0:
            h.free[i] = 1
        if time < s.air_from:  # a vented robot may still sink while it warns
            s.reference[i] = h.origin[i] = e.angle[i]
        if time < s.move.start:
            leash = _LEASH * p.home_stop_contact_lead[i]
            s.reference[i] = min(max(s.reference[i], e.angle[i] - leash), e.angle[i] + leash)
        elif time - measured_step < s.move.start:
            s.reference[i] = h.start[i] = e.angle[i]
    if not (time > h.since and measured_step > 0.0):
        return False
    if h.turn >= 3:
        return not p.home_stops or _go_back(s, p, e, time, measured_step)
    joint = p.home_order[h.turn]
    if not h.touching and h.free[joint] != 0 and indexed[joint] != 0:
        h.touching = True
        _begin_way(s, e, joint, time)
    if not h.touching:
        _seek(s, p, e, d, joint, time, measured_step)
    elif not p.home_stops or _press(s, p, e, joint, time, measured_step):
        h.turn, h.touching = h.turn + 1, not p.home_by_index
        s.reference[joint] = e.angle[joint]
        if h.turn < 3:
            _begin_way(s, e, p.home_order[h.turn], time)
        else:
            h.since = time
    return False


@compiled
def _begin_way(s: Any, e: Any, joint: int, time: float) -> None:
    """Start the next travel of `joint` at its present angle."""
    h = s.homing
    s.reference[joint] = h.start[joint] = h.pushed_at = e.angle[joint]
    h.since = h.pushed_since = time
    h.way = 1.0


@compiled
def _turn(s: Any, p: Any, joint: int, speed: float, time: float, measured_step: float) -> None:
    """Move the reference of `joint` on at `speed` (rad/s), from rest."""
    speed *= min((time - s.homing.since) / RAMP, 1.0)
    s.reference[joint] += speed * measured_step
    s.reference_velocity[joint] = speed
    s.feed_forward[joint] = s.move.gain[joint] * speed + p.move_band[joint] * direction(speed)


@compiled
def _push(
    s: Any, p: Any, e: Any, joint: int, speed: float, rests: float, time: float, measured_step: float
) -> None:
    """Turn `joint` on at `speed` (rad/s); note whether it rests, within `rests` rad, against its reference.

    The reference waits for a joint that lags: the air then presses it no harder. A valve that is hardly open
    yet does not count: its chambers are not charged.
    """
    h = s.homing
    lead = abs(s.reference[joint] - e.angle[joint])
    if lead < p.home_stop_contact_lead[joint]:
        _turn(s, p, joint, speed, time, measured_step)
    pushed = is_free(s, p, joint) and lead >= _FIRM * p.home_stop_contact_lead[joint]
    # By its angle, not its velocity, which the other joints shake.
    if not pushed or abs(e.angle[joint] - h.pushed_at) > rests:
        h.pushed_since, h.pushed_at = time, e.angle[joint]


@compiled
def _seek(s: Any, p: Any, e: Any, d: Any, joint: int, time: float, measured_step: float) -> None:
    """Turn `joint` on to its index: as far as it may or can, then in the other direction."""
    h = s.homing
    way = h.way * p.home_direction[joint]
    _push(s, p, e, joint, way * p.home_speed[joint], _RESTS, time, measured_step)
    far = way * (e.angle[joint] - h.start[joint]) > p.home_travel[joint]
    if h.way > 0.0 and (far or time - h.pushed_since > _PUSH_TIMEOUT):
        h.way, s.reference[joint] = -1.0, e.angle[joint]
        d.integral[joint] = 0.0  # what pressed it against its stop would press on
        h.since = h.pushed_since = time


@compiled
def _press(s: Any, p: Any, e: Any, joint: int, time: float, measured_step: float) -> bool:
    """Turn `joint` to its stop; return True once it has been pressed against it, at the stop's angle."""
    _push(
        s,
        p,
        e,
        joint,
        p.home_direction[joint] * p.home_stop_contact_speed[joint],
        _PRESSED,
        time,
        measured_step,
    )
    there = abs(e.angle[joint] - p.home_stop[joint]) <= p.home_stop_tolerance[joint]
    return bool(there and time - s.homing.pushed_since >= p.home_stop_contact_time)


@compiled
def _go_back(s: Any, p: Any, e: Any, time: float, measured_step: float) -> bool:
    """Move all joints back to where homing began; return True once their references are there.

    The reference waits for a joint that lags: at its stop the air first has to change sides.
    """
    back = True
    for i in range(3):
        way = s.homing.origin[i] - s.reference[i]
        if abs(way) > p.home_stop_contact_speed[i] * measured_step:
            back = False
            speed = p.home_stop_contact_speed[i] if way > 0.0 else -p.home_stop_contact_speed[i]
            if abs(s.reference[i] - e.angle[i]) < _EASE * p.home_stop_contact_lead[i]:
                _turn(s, p, i, speed, time, measured_step)
    return back


@compiled
def bounded(p: Any, opening: float) -> float:
    """Return the valve command `opening` within the limits of the search; NaN stays NaN, for the envelope."""
    return min(max(opening, -p.home_opening), p.home_opening) if np.isfinite(opening) else opening


@compiled
def search_cause(
    s: Any, p: Any, following: Any, max_tick_interval: float, angle: Any, velocity: Any, time: float
) -> int:
    """Return the cause that ends the search, or 0; `following` (3,) rad is the max following error.

    A joint that does not follow its reference, or is too fast, has its own cause: it, or its valve, may be
    stuck. While zeros are unknown the model-based check is blind to it.
    """
    h = s.homing
    if not 0.0 <= s.measured_step <= max_tick_interval:
        return Cause.TICK_GAP
    if not time - h.began <= p.home_timeout:
        return Cause.HOMING_FAILED
    for i in range(3):
        if h.free[i] == 0 and time > h.began:
            return Cause.HOMING_FAILED  # no new search has started: an earlier index is no evidence
    # Off its stop a full chamber throws a joint, whose zero is proven by then.
    faster = _FASTER if h.turn < 3 else 2.0 * _FASTER
    turned = p.home_order[h.turn] if h.turn < 3 else -1
    for i in range(3):
        if not abs(s.reference[i] - angle[i]) <= following[i]:
            return Cause.SHOULDER_FOLLOWING + i
        if not abs(velocity[i]) <= faster * p.home_speed[i]:
            return Cause.SHOULDER_FOLLOWING + i
        if i != turned:
            continue
        if h.touching and p.home_stops:
            beyond = p.home_direction[i] * (angle[i] - p.home_stop[i])
            rested = time - h.pushed_since
            most = p.home_stop_tolerance[i] if rested >= p.home_stop_contact_time else _OVERSHOOT
            if not (beyond <= most and rested <= _PUSH_TIMEOUT):
                return Cause.SHOULDER_ZERO + i
        elif not time - h.pushed_since <= 1.1 * _PUSH_TIMEOUT:
            return Cause.SHOULDER_FOLLOWING + i
        elif not abs(angle[i] - h.start[i]) <= p.home_travel[i] + _BEYOND:
            return Cause.HOMING_FAILED
    return 0
