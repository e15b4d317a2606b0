"""One PID controller per actuator, with the derivative on the estimated velocity.

    P = kp·(reference - angle)
    I = I + ki·(reference - angle)·dt
    D = kd·(reference_velocity - velocity)
    output = clip(P + I + D + feed_forward, -1, 1)

With the reference's velocity D does not brake a motion; the thesis' derivative lacks it. The velocity comes
from the estimator; nothing is differentiated here.

Anti-windup is conditional integration: a step of the integral may bring the output to its limit, but
not beyond, and the integral outside -1…1 only back. Back-calculation is not used: it needs an
additional time constant per actuator, and a spike of P or D would pull the integral the wrong way.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.control.law.gain_table import DERIVATIVE, INTEGRAL, PROPORTIONAL
from drivers.base.compiled import compiled, fields

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


@compiled
def control(
    state: np.ndarray[Any, Any],
    reference: np.ndarray[Any, Any],
    reference_velocity: np.ndarray[Any, Any],
    angle: np.ndarray[Any, Any],
    velocity: np.ndarray[Any, Any],
    feed_forward: np.ndarray[Any, Any],
    dt: float,
) -> None:
    """Compute one tick of all three controllers in place; arrays (3,) in rad, rad/s and valve commands.

    The gains are those in `state`. Allocates nothing and never raises. A non-finite input makes this tick's
    `output` NaN, for the envelope to see, and leaves the integral as it was.
    """
    s = state[0]
    for i in range(3):
        s.proportional[i] = s.gains[PROPORTIONAL, i] * (reference[i] - angle[i])
        s.derivative[i] = s.gains[DERIVATIVE, i] * (reference_velocity[i] - velocity[i])
        rest = s.proportional[i] + s.derivative[i] + feed_forward[i]
        before = s.integral[i]
        step = s.gains[INTEGRAL, i] * (reference[i] - angle[i]) * dt
        if not np.isfinite(rest + step):
            s.unsaturated[i] = np.nan
            s.output[i] = np.nan
            continue
        after = before + step
        if after > before:
            after = max(before, min(after, 1.0, 1.0 - rest))
        elif after < before:
            after = min(before, max(after, -1.0, -1.0 - rest))
        s.integral[i] = after
        s.unsaturated[i] = rest + after
        s.output[i] = min(max(s.unsaturated[i], -1.0), 1.0)


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
