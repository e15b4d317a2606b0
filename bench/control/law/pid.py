"""One PID controller per actuator, with the derivative on the estimated velocity.

    P = kp·(reference - angle)
    I = I + ki·(reference - angle)·dt
    D = kd·(reference_velocity - velocity)
    output = clip(P + I + D + feed_forward, lowest, highest)

With the reference's velocity D does not brake a motion; the thesis' derivative lacks it. The velocity comes
from the estimator; nothing is differentiated here.

Anti-windup is conditional integration: a step of the integral may bring the output to its limit, but
not beyond, and the integral outside lowest…highest only back. Back-calculation is not used: it needs an
additional time constant per actuator, and a spike of P or D would pull the integral the wrong way.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.control.law.gain_table import (
    DERIVATIVE,
    GAIN_TABLE_FIELDS,
    INTEGRAL,
    PROPORTIONAL,
    Gains,
    GainTable,
)
from drivers.base.compiled import compiled, fields, new_record

PID_PARAMETERS = np.dtype(
    [
        *GAIN_TABLE_FIELDS,
        *fields("f8", "lowest highest", (3,)),
    ],
    align=True,
)
"""The table of gains; per actuator: limits of the output."""

PID_STATE = np.dtype(
    [
        *fields("f8", "proportional integral derivative unsaturated output", (3,)),
        ("gains", "f8", (5, 3)),
        ("supply_factor", "f8"),
    ],
    align=True,
)
"""Per actuator: the three terms, their sum with the feed-forward, that sum within the limits, and this tick's
gains, in the order of `Gains`; the factor on them by the supply, 0 before the first one. Only `integral` and
the factor carry over to the next tick; the rest is for the log and the envelope."""

Values = tuple[float, float, float]


def design_pid(gains: GainTable, *, lowest: Values, highest: Values) -> np.ndarray[Any, Any]:
    """Return a PID_PARAMETERS record; tuples are in actuator order.

    Raises:
        ValueError: a value is not finite, a gain is negative, or the limits do not hold zero between them.
    """
    parameters = new_record(PID_PARAMETERS)
    given: dict[str, Any] = {"lowest": lowest, "highest": highest}
    for name, values in {**given, **gains._asdict()}.items():
        parameters[name] = values
    own = {name: gains.table[..., row, :] for row, name in enumerate(Gains._fields)}
    for name, values in {**given, **own}.items():
        if not np.all(np.isfinite(values)):
            raise ValueError(f"pid: {name} must be finite, found {values}")
        if name not in {"lowest", "highest"} and np.min(values) < 0:
            raise ValueError(f"pid: {name} must not be negative, found {np.min(values)}")
    if max(lowest) > 0 or min(highest) < 0 or np.any(np.array(lowest) == np.array(highest)):
        raise ValueError(f"pid: lowest ≤ 0 ≤ highest must hold and differ, found {lowest} and {highest}")
    return parameters


@compiled
def control(
    state: np.ndarray[Any, Any],
    parameters: np.ndarray[Any, Any],
    reference: np.ndarray[Any, Any],
    reference_velocity: np.ndarray[Any, Any],
    angle: np.ndarray[Any, Any],
    velocity: np.ndarray[Any, Any],
    feed_forward: np.ndarray[Any, Any],
    dt: float,
) -> None:
    """Compute one tick of all three controllers in place; arrays (3,) in rad, rad/s and output units.

    The gains are those in `state`. Allocates nothing and never raises. A non-finite input makes this tick's
    `output` NaN, for the envelope to see, and leaves the integral as it was.
    """
    s = state[0]
    p = parameters[0]
    _set_terms(s, reference, reference_velocity, angle, velocity)
    for i in range(3):
        low, high = p.lowest[i], p.highest[i]
        rest = s.proportional[i] + s.derivative[i] + feed_forward[i]
        before = s.integral[i]
        step = s.gains[INTEGRAL, i] * (reference[i] - angle[i]) * dt
        if not np.isfinite(rest + step):
            s.unsaturated[i] = np.nan
            s.output[i] = np.nan
            continue
        after = before + step
        if after > before:
            after = max(before, min(after, high, high - rest))
        elif after < before:
            after = min(before, max(after, low, low - rest))
        s.integral[i] = after
        s.unsaturated[i] = rest + after
        s.output[i] = _clip(s.unsaturated[i], low, high)


@compiled
def reset_integral(state: np.ndarray[Any, Any]) -> None:
    """Empty the three integrals and all terms."""
    s = state[0]
    for i in range(3):
        s.proportional[i] = 0.0
        s.integral[i] = 0.0
        s.derivative[i] = 0.0
        s.unsaturated[i] = 0.0
        s.output[i] = 0.0


@compiled
def _set_terms(
    s: Any,
    reference: np.ndarray[Any, Any],
    reference_velocity: np.ndarray[Any, Any],
    angle: np.ndarray[Any, Any],
    velocity: np.ndarray[Any, Any],
) -> None:
    """Set the proportional and derivative terms."""
    for i in range(3):
        s.proportional[i] = s.gains[PROPORTIONAL, i] * (reference[i] - angle[i])
        s.derivative[i] = s.gains[DERIVATIVE, i] * (reference_velocity[i] - velocity[i])


@compiled
def _clip(value: float, low: float, high: float) -> float:
    """Return `value` within low…high."""
    if value > high:
        return high
    if value < low:
        return low
    return value
