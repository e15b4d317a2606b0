"""The validity gate: a shot is valid by its delivery, never by the ball's result."""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, degrees, radians, sin
from typing import NamedTuple

import numpy as np

from bench.campaign.plan.plan import Gate
from bench.records.shot.shot import Shot
from bench.swing.profile import Profile
from sim.robot import Club


class Centre(NamedTuple):
    """The reference delivery of shots; None: unknown and not checked. SI, radians."""

    club_speed: float | None = None
    attack_angle: float | None = None
    shaft_lean: float | None = None
    """Dynamic loft less the club's loft: negative with the hands ahead."""
    strike_x: float | None = None
    strike_y: float | None = None


_WORDS = (
    ("club speed", "m/s", 2, 1.0),
    ("attack angle", "°", 2, degrees(1)),
    ("shaft lean (dynamic loft less loft)", "°", 2, degrees(1)),
    ("strike, heel to toe", "mm", 1, 1e3),
    ("strike, low to high", "mm", 1, 1e3),
)


def delivered(shot: Shot, club: Club) -> Centre:
    """Return the figures of the delivery of `shot` that the gate checks."""
    return Centre(
        shot.club_speed_mps,
        None if shot.attack_angle_deg is None else radians(shot.attack_angle_deg),
        None if shot.dynamic_loft_deg is None else radians(shot.dynamic_loft_deg) - club.loft,
        None if shot.strike_x_mm is None else shot.strike_x_mm / 1e3,
        None if shot.strike_y_mm is None else shot.strike_y_mm / 1e3,
    )


def median_delivery(shots: Sequence[Shot], club: Club) -> Centre:
    """Return the median of each figure over `shots`, all with `club`."""
    seen = [delivered(shot, club) for shot in shots]
    columns = ([v for v in column if v is not None] for column in zip(*seen, strict=True))
    return Centre(*(float(np.median(values)) if values else None for values in columns))


def planned_delivery(profile: Profile, lie: float) -> Centre:
    """Return the designed delivery of `profile`, its path in a plane tilted by `lie` (rad)."""
    plan = profile.delivery
    slope = plan.get("path_slope_deg")
    attack = None if slope is None else asin(sin(lie) * sin(radians(slope)))
    return Centre(plan.get("head_speed_mps"), attack, None, 0.0, 0.0)


OUTSIDE = {figure: f"{words[0]} outside" for figure, words in zip(Centre._fields, _WORDS, strict=True)}
"""Reason under which reports count a shot, by `Shot.gate_figure`."""


def outside(shot: Shot, club: Club, centre: Centre, gate: Gate) -> tuple[str, str]:
    """Return the first figure that makes the delivery of `shot` invalid, and why; both empty if valid."""
    if shot.delivery_source not in gate.sources:
        return "", f"delivery from {shot.delivery_source or 'no source'}, which the plan does not accept"
    half = (gate.club_speed, gate.attack_angle, gate.shaft_lean, gate.strike_x, gate.strike_y)
    found, first = [], ""
    rows = zip(OUTSIDE, delivered(shot, club), centre, half, _WORDS, strict=True)
    for figure, value, middle, width, (name, unit, digits, scale) in rows:
        if not width or middle is None:
            continue
        if value is None:
            found.append(f"{name} not measured")
        elif abs(value - middle) > width:
            found.append(
                f"{name} {scale * value:.{digits}f} {unit}, outside {scale * middle:.{digits}f} ± "
                f"{scale * width:.{digits}f} {unit} ({shot.delivery_source})"
            )
        first = first or (figure if found else "")
    return first, "; ".join(found)
