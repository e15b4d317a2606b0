"""Measured aerodynamics of a ball model: two factors on a published coefficient model, with uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from math import sqrt
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from bench.base.errors import BenchError
from bench.base.from_toml import Builder, as_tree
from drivers.base import Launch
from drivers.base.ranges import Range
from sim.aerodynamics import Air
from sim.ball import Ball
from sim.flight import Aerodynamics, Wind, fly_many
from sim.ground import Turf

BEYOND = 0.05
"""Share of speed and spin by which a launch may lie outside the measured range."""
_STEP = 0.005
"""Step of the factors for the derivatives of a carry."""

Factor = Annotated[float, Range(0.2, 3.0, "")]
FactorError = Annotated[float, Range(0.0, 1.0, "")]
Speed = Annotated[float, Range(0.0, 150.0, "m/s")]
Spin = Annotated[float, Range(0.0, 2000.0, "rad/s")]


@dataclass(frozen=True)
class BallAerodynamics:
    """Drag and lift of a ball model as factors on the coefficients of `model`, fitted to measured flights."""

    ball: str
    """Name of the ball model in plans."""
    mass: Annotated[float, Range(0.02, 0.06, "kg")]
    radius: Annotated[float, Range(0.015, 0.03, "m")]
    model: str
    """Name of a `sim.aerodynamics.Aerodynamics`."""
    drag_factor: Factor
    lift_factor: Factor
    drag_error: FactorError
    """Standard uncertainty of the drag factor."""
    lift_error: FactorError
    correlation: Annotated[float, Range(-1.0, 1.0, "")]
    """Correlation of the two errors."""
    flights: Annotated[int, Range(1, 1_000_000, "")]
    """Number of flights of the fit."""
    min_speed: Speed
    """Min ball speed of these flights, m/s."""
    max_speed: Speed
    min_spin: Spin
    """Min spin of these flights, rad/s."""
    max_spin: Spin
    chi_square: Annotated[float, Range(0.0, 1e9, "")]
    """Chi square of the fit per degree of freedom; 1 where the stated scatter holds."""

    def __post_init__(self) -> None:
        """Raise ValueError if the model is unknown."""
        if self.model not in Aerodynamics.__members__:
            raise ValueError(f"model: {self.model}, expected one of {', '.join(Aerodynamics.__members__)}")

    @property
    def as_flown(self) -> Ball:
        """The ball with these coefficients."""
        return self._with(self.drag_factor, self.lift_factor)

    @property
    def aerodynamics(self) -> Aerodynamics:
        """The coefficient model that the factors belong to."""
        return Aerodynamics[self.model]

    def outside(self, launch: Launch) -> str:
        """Return why `launch` lies outside the measured range; empty if it does not."""
        for name, value, low, high, unit, scale in (
            ("ball speed", launch.speed, self.min_speed, self.max_speed, "m/s", 1.0),
            ("spin", launch.spin, self.min_spin, self.max_spin, "rpm", 30.0 / np.pi),
        ):
            if not (1 - BEYOND) * low <= value <= (1 + BEYOND) * high:
                return (
                    f"{name} {scale * value:.1f} {unit}, aerodynamics of {self.ball} measured from "
                    f"{scale * low:.1f} to {scale * high:.1f} {unit}"
                )
        return ""

    def carry_error(self, launch: Launch, air: Air, wind: Wind, turf: Turf) -> float:
        """Return the standard uncertainty of a carry (m) from that of the two factors."""
        d, f, h = self.drag_factor, self.lift_factor, _STEP
        carries = [
            float(fly_many(np.array([launch]), air, ball, wind, turf, self.aerodynamics)["carry"][0])
            for ball in (
                self._with(d + h, f),
                self._with(d - h, f),
                self._with(d, f + h),
                self._with(d, f - h),
            )
        ]
        by_drag, by_lift = (carries[0] - carries[1]) / (2 * h), (carries[2] - carries[3]) / (2 * h)
        one, two = by_drag * self.drag_error, by_lift * self.lift_error
        return sqrt(max(one * one + two * two + 2 * self.correlation * one * two, 0.0))

    def _with(self, drag: float, lift: float) -> Ball:
        return Ball(self.ball, self.mass, self.radius, drag_factor=drag, lift_factor=lift)


@dataclass(frozen=True)
class AerodynamicsEntry:
    """One stored measurement of a ball model's aerodynamics."""

    version: int
    """Rises by one per bench and ball."""
    date: datetime
    source: str
    """Device and place that the flight data come from."""
    by: str
    values: BallAerodynamics

    @property
    def text(self) -> str:
        """Coefficients with uncertainty, source and date, for people."""
        v = self.values
        return (
            f"drag {v.drag_factor:.4f} ± {v.drag_error:.4f}, lift {v.lift_factor:.4f} ± {v.lift_error:.4f} "
            f"times {v.model} (standard errors, correlation {v.correlation:+.2f}), {v.flights} flights "
            f"at {v.min_speed:.1f} to {v.max_speed:.1f} m/s, chi square per degree of freedom "
            f"{v.chi_square:.2f}; {self.source}, {self.date:%Y-%m-%d}, version {self.version}, "
            f"by {self.by}"
        )

    def record(self) -> dict[str, Any]:
        """Return it as JSON values; `aerodynamics_from_record` reads them back."""
        return {
            "version": self.version,
            "date": self.date.isoformat(),
            "source": self.source,
            "by": self.by,
            "values": asdict(self.values),
        }


def aerodynamics_values(content: Mapping[str, Any], location: str) -> BallAerodynamics:
    """Return the checked values of `content`, whose keys are the fields of `BallAerodynamics`.

    Raises:
        ExceptionGroup: one BenchError at `location` per value that is missing, unknown or out of range.
    """
    faults: list[BenchError] = []
    file = Path(location)
    builder = Builder(as_tree(content, file, faults), file, "Measure again.", "Give it.", faults=faults)
    values = builder.build(BallAerodynamics)
    if faults:
        raise ExceptionGroup(f"{location} is invalid", faults)
    return values  # type: ignore[no-any-return]


def aerodynamics_from_record(record: Mapping[str, Any], location: str) -> AerodynamicsEntry:
    """Return the measurement that `AerodynamicsEntry.record` gave. Raises as `aerodynamics_values`."""
    return AerodynamicsEntry(
        int(record["version"]),
        datetime.fromisoformat(record["date"]),
        str(record["source"]),
        str(record["by"]),
        aerodynamics_values(record["values"], location),
    )
