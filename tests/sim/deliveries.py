"""Deliveries as a launch monitor states them, and heads in a collision."""

from __future__ import annotations

from math import cos, sin

import numpy as np

from drivers.base.compiled import new_record
from sim.ball import Ball
from sim.impact import IMPACT, Delivery, Source


def delivery_from_angles(
    speed: float,
    attack_angle: float,
    path: float,
    face_angle: float,
    dynamic_loft: float,
    strike_x: float = 0.0,
    strike_y: float = 0.0,
    source: Source = "launch monitor",
    shaft_loft: float = 0.0,
) -> Delivery:
    """Return the delivery that a launch monitor states: m/s, rad, m, signs as in `Delivery`.

    `dynamic_loft` includes `shaft_loft`.
    """
    level = speed * cos(attack_angle)
    velocity = (level * cos(path), speed * sin(attack_angle), level * sin(path))
    return Delivery(
        velocity,
        face_angle,
        dynamic_loft,
        strike_x=strike_x,
        strike_y=strike_y,
        source=source,
        shaft_loft=shaft_loft,
    )


def head_parameters(head_mass: float, inertia: tuple[float, ...], **values: float) -> np.ndarray:
    """Return IMPACT of a head with `inertia` about its axes that meets the standard ball."""
    record, ball = new_record(IMPACT), Ball()
    values |= {"ball_mass": ball.mass, "ball_radius": ball.radius, "ball_inertia": ball.inertia}
    values |= {f"head_inertia_{axis}": one for axis, one in zip("nht", inertia, strict=True)}
    for name, value in (values | {"head_mass": head_mass}).items():
        record[name] = value
    return record
