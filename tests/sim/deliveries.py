"""Deliveries as a launch monitor states them."""

from __future__ import annotations

from math import cos, sin

from sim.impact import Delivery, Source


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
