"""The golf ball of impact and flight, and the air that it flies through.

Density of air: CIPM-2007 (Picard et al., Metrologia 45 (2008) 149) with 400 ppm CO2; stated range 600-1100
hPa and 15-27 degrees C, smooth and within 0.1 % well beyond it. Viscosity: Sutherland's law for dry air.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sqrt
from typing import Annotated

from drivers.base.ranges import Range, check_ranges

_ZERO_CELSIUS = 273.15
_STANDARD_PRESSURE = 101325.0


@dataclass(frozen=True)
class Ball:
    """A ball model. Defaults: the heaviest and smallest ball the Rules allow, average surface.

    `inertia_factor` is I/(m r2), 0.4 for a uniform sphere. The factors multiply the club's restitution
    and the aerodynamic model's drag and lift coefficient: they distinguish ball models.
    A value outside its physical range raises ValueError.
    """

    name: str = "standard"
    mass: Annotated[float, Range(0.02, 0.06, "kg")] = 0.04593
    """kg; the heaviest ball the Rules allow by default."""
    radius: Annotated[float, Range(0.015, 0.03, "m")] = 0.021335
    """Radius (m); the smallest ball the Rules allow by default."""
    inertia_factor: Annotated[float, Range(0.2, 2.0 / 3.0, "(hollow shell at most)")] = 0.4
    """I/(m r2); 0.4 is a uniform sphere."""
    restitution_factor: Annotated[float, Range(0.3, 1.2, "")] = 1.0
    """Factor on the club's restitution."""
    friction: Annotated[float, Range(0.0, 2.0, "")] = 0.4
    """Coulomb friction coefficient of cover on club face; sliding starts only far above a driver's loft."""
    drag_factor: Annotated[float, Range(0.0, 3.0, "")] = 1.0
    """Factor on the flight model's drag."""
    lift_factor: Annotated[float, Range(0.0, 3.0, "")] = 1.0
    """Factor on the flight model's lift."""

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def inertia(self) -> float:
        """Moment of inertia (kg m2)."""
        return self.inertia_factor * self.mass * self.radius**2


REFERENCE_BALL = Ball("reference")
"""The ball whose flights compare launches: all balls alike, no factor on the flight model."""


@dataclass(frozen=True)
class Air:
    """Still air: `temperature` K, `pressure` Pa (at the place, not reduced to sea level), humidity 0..1.

    The default, 25 degrees C at sea level, is the condition that launch monitors normalise to.
    A value outside its physical range raises ValueError.
    """

    temperature: Annotated[float, Range(233.15, 333.15, "K")] = 298.15
    """K; 25 deg C by default, to which launch monitors normalise."""
    pressure: Annotated[float, Range(20_000.0, 120_000.0, "Pa")] = _STANDARD_PRESSURE
    """Pressure at the place, not reduced to sea level (Pa)."""
    relative_humidity: Annotated[float, Range(0.0, 1.0, "as a fraction (0.5 is 50 %)")] = 0.5
    """Share, 0 to 1."""

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def density(self) -> float:
        """Density of moist air (kg/m3), CIPM-2007."""
        T, p = self.temperature, self.pressure
        t = T - _ZERO_CELSIUS
        saturation = exp(1.2378847e-5 * T**2 - 1.9121316e-2 * T + 33.93711047 - 6.3431645e3 / T)
        enhancement = 1.00062 + 3.14e-8 * p + 5.6e-7 * t**2
        x = self.relative_humidity * enhancement * saturation / p
        compressibility = (
            1.0
            - p
            / T
            * (
                1.58123e-6
                - 2.9331e-8 * t
                + 1.1043e-10 * t**2
                + (5.707e-6 - 2.051e-8 * t) * x
                + (1.9898e-4 - 2.376e-6 * t) * x**2
            )
            + (p / T) ** 2 * (1.83e-11 - 0.765e-8 * x**2)
        )
        return 3.483740e-3 * p / (compressibility * T) * (1.0 - 0.3780 * x)

    @property
    def viscosity(self) -> float:
        """Dynamic viscosity (Pa s), Sutherland: 1.716e-5 at 0 degrees C, constant 110.4 K."""
        ratio = self.temperature / _ZERO_CELSIUS
        return 1.716e-5 * ratio * sqrt(ratio) * (_ZERO_CELSIUS + 110.4) / (self.temperature + 110.4)
