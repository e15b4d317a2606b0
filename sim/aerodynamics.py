"""Published drag and lift coefficients of a golf ball, as functions of Reynolds number and spin ratio.

Re = 2 r V / nu, S = r omega / V, V the speed through the air; both coefficients refer to the ball's
cross-section. Nothing here was fitted by this project.
"""

from __future__ import annotations

from enum import IntEnum
from math import pi, sin

from drivers.base.compiled import compiled


class Aerodynamics(IntEnum):
    """Coefficient models; compiled code gets the number."""

    LIBGOLF = 0
    """libgolf's default: `include/DefaultAerodynamicModel.hpp` and `docs/aerodynamic_model.md` of
    github.com/gdifiore/libgolf, commit 1094535 (after Lyu, Washington State University 2018, and Bearman
    and Harvey 1976). Our own implementation of its equations. Any Re and S."""
    SMITS_SMITH = 1
    """Smits and Smith 1994 (Science and Golf II), as printed in patent US 11230375. Measured for
    70e3 < Re < 210e3 and 0.08 < S < 0.2; Re is held at the ends of that range."""


SPIN_DECAY = 2.0e-5
"""d omega/dt = -SPIN_DECAY omega V / r (Smits and Smith 1994; libgolf uses the same)."""


@compiled
def coefficients(model: int, reynolds: float, spin_ratio: float) -> tuple[float, float]:
    """Return (drag, lift) coefficient of `model` (an `Aerodynamics` number)."""
    if model == 1:
        return _smits_smith(reynolds, spin_ratio)
    return _libgolf(reynolds, spin_ratio)


@compiled
def _libgolf(reynolds: float, S: float) -> tuple[float, float]:
    re = reynolds * 1e-5
    drag = 0.5 - 0.3 * min(max((re - 0.5) / 0.5, 0.0), 1.0) + 0.18 * S  # a linear drag crisis
    ceiling = 0.268 + 0.052 * min(max((S - 0.35) / 0.15, 0.0), 1.0)
    if S <= 0.0 or re <= 0.3:
        return drag, 0.0
    if re < 0.5:
        x = (re - 0.3) / 0.2
        lift = _lift_at_50000(S) * x * x * (3.0 - 2.0 * x)
    elif re < 0.6:
        lift = _between(re, 0.5, _lift_at_50000(S), 0.6, _lift_at_60000(S))
    elif re < 0.65:
        lift = _between(re, 0.6, _lift_at_60000(S), 0.65, _lift_at_65000(S))
    elif re < 0.7:
        lift = _between(re, 0.65, _lift_at_65000(S), 0.7, _lift_at_70000(S))
    else:
        lift = ceiling * 16.0 * S / (1.0 + 16.0 * S)  # saturating; steps at Re = 70,000 as published
    return drag, min(max(lift, 0.0), ceiling)


@compiled
def _between(x: float, x0: float, y0: float, x1: float, y1: float) -> float:
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)


@compiled
def _lift_at_50000(S: float) -> float:
    return 0.0472121 + S * (2.84795 + S * (-23.4342 + S * 45.4849))


@compiled
def _lift_at_60000(S: float) -> float:
    return 0.320524 + S * (-4.7032 + S * 14.0613)


@compiled
def _lift_at_65000(S: float) -> float:
    return 0.266667 + S * (-4.0 + S * 13.3333)


@compiled
def _lift_at_70000(S: float) -> float:
    return 0.0496189 + S * (0.00211396 + S * 2.34201)


@compiled
def _smits_smith(reynolds: float, S: float) -> tuple[float, float]:
    re = min(max(reynolds, 70e3), 210e3)
    drag = 0.24 + 0.18 * S + 0.06 * sin(pi * (re - 90e3) / 200e3)
    return drag, 0.54 * max(S, 0.0) ** 0.4
