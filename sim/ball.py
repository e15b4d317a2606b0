"""Golf ball model for impact and flight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from drivers.base.ranges import Range, check_ranges


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
