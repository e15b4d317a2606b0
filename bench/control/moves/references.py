"""References of the swing and of slow moves, and their feed-forward valve commands.

All pure but for the control record `s`, which they set: `s.reference`, its derivatives and `s.feed_forward`.
"""

from __future__ import annotations

from math import floor, sqrt
from typing import Any

from bench.base.lifecycle import Phase
from bench.control.law.feed_forward import pneumatic_opening
from bench.control.moves.first_motion import TEST_TIME, choose_target
from bench.control.moves.ground_clearance import joint_progress, moves_arm_first
from drivers.base.compiled import compiled

_SLOW = 0.05
"""Speed of a slow motion that counts as rest (rad/s)."""


@compiled
def follow_profile(parameters: Any, s: Any, time: float) -> bool:
    """Set reference, feed-forward and phase of the swing at `time`; return False once it is over."""
    profile = parameters.profile[0]
    # A ten-millionth of a sample guards the floor against rounding of exact ticks.
    sample = (time - s.swing.start) / profile.period + 1e-7
    if not sample >= 0.0:  # a clock that runs backwards, or is NaN, stays within the tables
        sample = 0.0
    last = profile.samples - 1
    over = sample >= last
    if over:
        k, part = last - 1, 1.0
    else:
        k = floor(sample)
        part = max(sample - k - 1e-7, 0.0)
    s.swing.sample = min(k + 1, last) if over else k
    angle, velocity, valve = parameters.angle, parameters.velocity, parameters.valve
    for i in range(3):
        change = velocity[k + 1, i] - velocity[k, i]
        s.reference[i] = angle[k, i] + part * (angle[k + 1, i] - angle[k, i])
        s.reference_velocity[i] = velocity[k, i] + part * change
        s.reference_acceleration[i] = change / profile.period
        s.feed_forward[i] = valve[k, i] + part * (valve[k + 1, i] - valve[k, i])
    s.phase = parameters.phase[s.swing.sample]
    return not over


@compiled
def begin_move(parameters: Any, s: Any, start: Any, time: float) -> None:
    """Begin a slow move from angles `start` to the address (the profile's first sample), or a test motion."""
    p, comes_back = parameters.control[0], s.move.is_test
    choose_target(s, parameters, start)
    s.move.duration = TEST_TIME if s.move.is_test or comes_back else 0.3
    for i in range(3):
        s.move.origin[i] = start[i]
        # The max speed of a quintic is 15/8 of its mean.
        s.move.duration = max(s.move.duration, 1.875 * abs(s.move.target[i] - start[i]) / p.move_speed[i])
    s.move.arm_first = moves_arm_first(parameters, start, s.move.target)
    if s.move.arm_first:
        s.move.duration *= 2.0
    s.move.start = time
    s.moving = True
    s.phase = Phase.RETURN


@compiled
def follow_move(parameters: Any, s: Any, time: float) -> bool:
    """Set the reference of the slow move at `time` (quintic: rest to rest); return False once it is over."""
    p = parameters.control[0]
    whole = min(max((time - s.move.start) / s.move.duration, 0.0), 1.0)
    own_time = 0.5 * s.move.duration if s.move.arm_first else s.move.duration
    for i in range(3):
        part = joint_progress(whole, i, s.move.arm_first)
        shape = part * part * part * (10.0 - 15.0 * part + 6.0 * part * part)
        slope = 30.0 * part * part * (1.0 - part) * (1.0 - part) / own_time
        bend = 60.0 * part * (1.0 - part) * (1.0 - 2.0 * part) / (own_time * own_time)
        way = s.move.target[i] - s.move.origin[i]
        s.reference[i] = s.move.origin[i] + way * shape
        s.reference_velocity[i] = way * slope
        s.reference_acceleration[i] = way * bend
        # Dither alone carries the spools beyond their dead band.
        band = 0.0 if parameters.profile[0].air_planned else p.move_band[i] * direction(way * slope)
        s.feed_forward[i] = s.move.gain[i] * way * slope + band
    return bool(whole < 1.0)


@compiled
def direction(speed: float) -> float:
    """Return the direction of a slow motion at `speed` (rad/s), -1 to 1: without a jump through rest."""
    return speed / sqrt(speed * speed + _SLOW * _SLOW)


@compiled
def charging(s: Any, time: float) -> bool:
    """Return whether the chambers are being charged before the first move."""
    return bool((s.moving or s.phase == Phase.HOMING) and time < s.move.start)


@compiled
def square_wave(periods: float) -> float:
    """Return a square wave after `periods`: 1 in the first half of each, -1 in the second."""
    # A millionth of a period guards the floor against rounding of exact ticks.
    periods += 1e-6
    return 1.0 if periods - floor(periods) < 0.5 else -1.0


@compiled
def feed_model_forward(state: Any, parameters: Any, time: float) -> None:
    """Set the swing's feed-forward at `time` from the demanded forces, not the planned valve commands."""
    s, p, profile = state.control[0], parameters.control[0], parameters.profile[0]
    machine, force, rate = parameters.plant[0], parameters.force, parameters.force_rate
    k = min(s.swing.sample, profile.samples - 2)
    part = min(max((time - s.swing.start) / profile.period - k, 0.0), 1.0)
    for i in range(3):
        changing = rate[k, i] + part * (rate[k + 1, i] - rate[k, i])
        wanted = force[k, i] + part * (force[k + 1, i] - force[k, i])
        s.feed_forward[i] = pneumatic_opening(
            machine,
            parameters.robot,
            i,
            state.air[0],
            s.reference,
            s.reference_velocity,
            wanted,
            changing,
            p.force_gain[i],
        )
