"""The gains of all three joints at one pose."""

from __future__ import annotations

from typing import NamedTuple

Triple = tuple[float, float, float]


class Gains(NamedTuple):
    """Opening per rad, rad s, rad/s and rad/s2; and per rad/s of the reference in slow moves."""

    proportional: Triple
    integral: Triple
    derivative: Triple
    damping: Triple
    move: Triple
