"""Outlines that the clearance checks use, as bodies that can collide.

`bench/control/envelope.py` and `bench/design/static_checks.py` take the club as the line from the wrist to
the centre of the face with a sole at `plant.site.sole_depth` below it, the frame as a disc of
`envelope.frame_radius` round R1, and the ground as a line. Here the same settings become solids; the checks'
numbers stay their own.
"""

from __future__ import annotations

from typing import NamedTuple

from sim.plant import PlantParameters

_FRAME_LENGTH = 0.10


class CollisionOutline(NamedTuple):
    """Outlines in their bodies' frames (m); the club's line is as thick as its shaft."""

    club_length: float
    """Line of the club from R3 to the centre of the face."""
    club_radius: float
    sole_radius: float
    """Ball round the centre of the face whose lowest point is the sole."""
    frame_radius: float
    """Cylinder round R1, `frame_length` long across the swing plane."""
    frame_length: float
    ground: float
    """Height of the ground line in the swing plane."""


def collision_outline(plant: PlantParameters, frame_radius: float) -> CollisionOutline:
    """Return the outlines of a plant; `frame_radius` is the envelope's (m)."""
    club, site = plant.robot.club, plant.site
    return CollisionOutline(
        club.length_to_face, club.shaft_radius, site.sole_depth, frame_radius, _FRAME_LENGTH, site.ground
    )
