"""Outlines that the clearance checks use, as bodies that can collide.

`bench/control/envelope.py` and `bench/design/validate.py` take the club as the line from the wrist to the
centre of the face with a sole at `plant.site.sole_depth` below it, the frame as a disc of
`envelope.frame_radius` round R1, and the ground as a line. Here the same settings become solids; the checks'
numbers stay their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.drawing.placement import Array
from sim.kinematics import joint_positions
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


def clearances(plant: PlantParameters, outline: CollisionOutline, q: Array) -> tuple[Array, Array]:
    """Return the sole's height over ground and the club's distance to R1 (m) at joint angles `q` (n, 3)."""
    points = joint_positions(plant.robot, q)
    wrist = points[:, 2]
    along = (points[:, 4] - wrist) / plant.robot.club.length_to_face
    face = wrist + outline.club_length * along
    nearest = np.clip(-(wrist * along).sum(axis=1), 0.0, outline.club_length)
    distance: Array = np.linalg.norm(wrist + nearest[:, None] * along, axis=1)
    return face[:, 1] - outline.sole_radius - outline.ground, distance
