"""The four figures of a delivery that a planar robot can learn."""

from __future__ import annotations

from math import asin, radians, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.simulation.series import Bench
from sim.impact import Delivery

Array = NDArray[np.float64]


class Figures(NamedTuple):
    """A delivery in figures of the swing plane, SI and rad; NaN where the source has no value."""

    strike: float
    """Strike point on the face, along its cut with the swing plane, m, up the plane."""
    speed: float
    """Head speed, m/s."""
    lean: float
    """Shaft lean, rad."""
    attack: float
    """rad"""

    @property
    def array(self) -> Array:
        """All four in order."""
        return np.array(self)

    @property
    def shown(self) -> dict[str, float | None]:
        """The figures with their units in the names; None where unknown."""
        values = (1e3 * self.strike, self.speed, np.degrees(self.lean), np.degrees(self.attack))
        names = ("strike_mm", "head_speed_mps", "shaft_lean_deg", "attack_angle_deg")
        return {
            name: None if np.isnan(value) else float(value) for name, value in zip(names, values, strict=True)
        }


UNKNOWN = Figures(*[float("nan")] * 4)


class Tolerance(NamedTuple):
    """Errors within which a figure counts as learned."""

    strike: float = 0.002
    """m"""
    speed: float = 0.003
    """Share of the target."""
    lean: float = radians(0.3)
    attack: float = radians(0.3)

    def scale(self, target: Figures) -> Array:
        """Return the tolerances (4,) in the figures' units."""
        return np.array([self.strike, self.speed * target.speed, self.lean, self.attack])


def figures_of(delivery: Delivery | None) -> Figures:
    """Return the figures of `delivery`; all unknown without one."""
    if delivery is None:
        return UNKNOWN
    return Figures(delivery.in_plane_error, delivery.speed, delivery.shaft_lean, delivery.attack_angle)


def planned_figures(bench: Bench) -> Figures:
    """Return the delivery that the profile plans: what learning aims at and controllers are compared by.

    Raises:
        BenchError: its file lacks it.
    """
    delivery, lie = bench.profile.delivery, bench.model.robot.lie
    wanted = ("in_plane_error_mm", "head_speed_mps", "shaft_lean_deg", "path_slope_deg")
    missing = [key for key in wanted if key not in delivery]
    if missing:
        raise BenchError(
            f"{bench.profile.name}: delivery",
            f"no {missing[0]}",
            "the planned delivery",
            "Take a profile of `golfbench profile design`.",
        )
    strike, speed, lean, slope = (delivery[key] for key in wanted)
    return Figures(1e-3 * strike, speed, radians(lean), asin(sin(radians(slope)) * sin(lie)))
