"""Conversion of encoder counts to continuous joint angles, without impossible jumps.

An absolute single-turn encoder gives a count modulo its range. The branch of every absolute count is the one
nearest to the middle of the joint's travel, which is narrower than the range (`design_encoders` requires it).
The branch therefore depends on no earlier sample: garbage that was accepted leaves no whole turns behind.
An incremental count before its index has no known zero. It is unwrapped against the last accepted count, in
whole counts, so that nothing drifts. After a gap in which half a range could have passed, it is also placed
nearest to the middle of the travel.

A jump beyond the joint's possible travel since the last accepted sample is IMPLAUSIBLE and rejected. This
time continues to run: a joint that really is elsewhere is accepted once it could have travelled that far.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.base.compiled import compiled, fields, new_record

FRESH = 0
"""A new, plausible sample."""
INVALID = 1
"""The device itself calls the channel invalid."""
REPEATED = 2
"""The sample of an earlier tick again: no new information."""
STALE = 3
"""Older (or further in the future) than `max_age`, or without a finite time."""
IMPLAUSIBLE = 4
"""A count outside the range, or a jump beyond the possible speed."""

ENCODER_PARAMETERS = np.dtype(
    [
        ("counts_per_revolution", "f8", (3,)),
        ("count_range", "i8", (3,)),
        *fields("f8", "zero_count sign middle max_speed tolerance max_age", (3,)),
    ],
    align=True,
)
"""Per joint: counts per revolution; counts 0 … range-1; count at angle zero; +1 or -1; middle of the travel
(rad); max possible speed (rad/s); counts allowed beyond it (noise, jitter); max age (s)."""

ENCODER_STATE = np.dtype(
    [
        *fields("f8", "angle age sample_time", (3,)),
        *fields("i8", "unwrapped rejected", (3,)),
        *fields("u1", "verdict fresh started indexed zero_set", (3,)),
    ],
    align=True,
)
"""Per joint: angle (rad) of the last accepted sample, its age (s) at this tick and its time (s); the
unwrapped count; consecutive ticks with an implausible sample; this tick's verdict; 1 if fresh; 1 once a
sample was accepted; whether the count is absolute; 1 in the tick in which that changed, and with it the
zero: the sample is then not compared with those before."""

_TURN = 2.0 * np.pi
_MAX_SPEED = (60.0, 60.0, 120.0)
"""Max possible speed of the joints (rad/s)."""
_TOLERANCE = 4.0
"""Counts that a sample may be off by noise and jitter."""
_MAX_AGE = 0.005
"""Max age of a sample (s)."""


def design_encoders(
    *,
    counts_per_revolution: int,
    zero_count: tuple[float, float, float],
    sign: tuple[int, int, int],
    travel: tuple[tuple[float, float], tuple[float, float], tuple[float, float]],
) -> np.ndarray[Any, Any]:
    """Return an ENCODER_PARAMETERS record of single-turn encoders; tuples are in joint order.

    `travel` is each joint's (lowest, highest) angle (rad) that its stops allow.

    Raises:
        ValueError: a joint's travel does not fit into a revolution, so that a count could mean two angles.
    """
    for joint, (low, high) in enumerate(travel):
        if not 0.0 < high - low < _TURN:
            raise ValueError(f"encoder of joint {joint}: travel {low} … {high} rad does not fit into a turn")
    parameters = new_record(ENCODER_PARAMETERS)
    parameters["counts_per_revolution"] = parameters["count_range"] = counts_per_revolution
    parameters["zero_count"], parameters["sign"] = zero_count, sign
    parameters["middle"], parameters["max_speed"] = np.mean(travel, axis=1), _MAX_SPEED
    parameters["tolerance"], parameters["max_age"] = _TOLERANCE, _MAX_AGE
    return parameters


@compiled
def _unwrap(s: Any, p: Any, i: int, count: int, sample_time: float) -> tuple[int, int, float]:
    """Return encoder `i`'s unwrapped count, its change since the last sample and how far it can have changed.

    An absolute count lies on the turn nearest the middle of the joint's travel, whatever came before; one
    that counts from power-up lies nearest the last sample.
    """
    span, per_radian = p.count_range[i], p.counts_per_revolution[i] / _TURN
    reach = 0.5 * span
    anchored = False
    if s.started[i]:
        reach = p.max_speed[i] * (sample_time - s.sample_time[i]) * per_radian + p.tolerance[i]
        anchored = reach < 0.5 * span
    jump = 0
    if anchored and s.indexed[i] == 0:
        jump = (count - s.unwrapped[i] + span // 2) % span - span // 2
        unwrapped = s.unwrapped[i] + jump
    else:
        centre = p.zero_count[i] + p.sign[i] * p.middle[i] * per_radian
        unwrapped = count + span * int(np.floor((centre - count) / span + 0.5))
        if anchored:
            jump = unwrapped - s.unwrapped[i]
    return unwrapped, jump, reach


@compiled
def decode_encoders(
    state: np.ndarray[Any, Any],
    parameters: np.ndarray[Any, Any],
    readings: np.ndarray[Any, Any],
    time: float,
) -> None:
    """Judge and unwrap the counts of one READINGS record at `time` (s), in place in ENCODER_STATE.

    Only where `fresh` is 1 is `angle` a new measurement, taken `age` before `time`. Allocates nothing,
    never raises; a non-finite time makes a channel stale.
    """
    s = state[0]
    p = parameters[0]
    r = readings[0]
    for i in range(3):
        s.fresh[i] = s.zero_set[i] = 0
        s.age[i] = time - s.sample_time[i]
        sample_time = r.encoder_time[i]
        count = r.encoder_count[i]
        if r.encoder_valid[i] == 0:
            s.verdict[i] = INVALID
            continue
        if s.sample_time[i] > time + p.max_age[i]:
            s.started[i] = 0  # the clock went back: earlier samples do not bound the joint's travel
        if s.started[i] and sample_time <= s.sample_time[i]:
            s.verdict[i] = REPEATED
            continue
        if not abs(time - sample_time) <= p.max_age[i]:  # so that NaN is also stale
            s.verdict[i] = STALE
            continue
        if r.encoder_indexed[i] != s.indexed[i]:
            s.indexed[i] = r.encoder_indexed[i]
            s.zero_set[i] = s.started[i]
            s.started[i] = 0
        span, per_radian = p.count_range[i], p.counts_per_revolution[i] / _TURN
        unwrapped, jump, reach = _unwrap(s, p, i, count, sample_time)
        if count < 0 or count >= span or abs(jump) > reach:
            s.verdict[i] = IMPLAUSIBLE
            s.rejected[i] += 1
            continue
        s.unwrapped[i] = unwrapped
        s.angle[i] = p.sign[i] * (unwrapped - p.zero_count[i]) / per_radian
        s.sample_time[i] = sample_time
        s.age[i] = time - sample_time
        s.rejected[i] = 0
        s.started[i] = 1
        s.fresh[i] = 1
        s.verdict[i] = FRESH
