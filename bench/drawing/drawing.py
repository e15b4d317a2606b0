"""All drawn bodies of a configured robot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.drawing.bodies import DrawnBody
from bench.drawing.club import club_body
from bench.drawing.links import left_arm, right_arm_cylinder, right_arm_rod, shoulder_link, wrist_rod
from bench.drawing.mesh import Mesh, placed_mesh
from bench.drawing.placement import Array, address, body_poses, plane_to_golf
from bench.drawing.surroundings import ball, drive, guard, stand, tee
from sim.plant import PlantParameters


class Drawing(NamedTuple):
    """Bodies by the frame they are drawn in."""

    moving: tuple[DrawnBody, ...]
    """Each in its own frame, placed by `body_poses`."""
    fixed_in_plane: tuple[DrawnBody, ...]
    """In the swing plane's frame."""
    fixed: tuple[DrawnBody, ...]
    """In the golf frame."""


class PlacedBody(NamedTuple):
    """A body with its pose in the golf frame: golf = turn @ own + at."""

    body: DrawnBody
    turn: Array
    at: Array

    @property
    def mesh(self) -> Mesh:
        """Surface in the golf frame."""
        return placed_mesh(self.body.mesh, self.turn, self.at)


def draw(plant: PlantParameters) -> Drawing:
    """Return the drawn bodies of the robot, its drive, stand, tee, ball and guard."""
    return Drawing(
        moving=(
            shoulder_link(plant),
            left_arm(plant),
            wrist_rod(plant),
            club_body(plant),
            right_arm_rod(plant),
            right_arm_cylinder(plant),
        ),
        fixed_in_plane=(drive(plant),),
        fixed=(stand(plant), tee(plant), ball(plant), guard(plant)),
    )


def placed(plant: PlantParameters, q: Array | None = None) -> list[PlacedBody]:
    """Return all bodies in the golf frame for joint angles `q` (rad), at address by default."""
    drawing = draw(plant)
    axes, origin = plane_to_golf(plant.robot, plant.site)
    poses = body_poses(plant, np.atleast_2d(address(plant) if q is None else q))
    bodies = []
    for body in drawing.moving:
        (point,), (quaternion,) = poses[body.name]
        s, c = 2 * quaternion[2] * quaternion[3], 1 - 2 * quaternion[2] ** 2
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        bodies.append(PlacedBody(body, axes @ turn, axes @ point + origin))
    bodies += [PlacedBody(body, axes, origin) for body in drawing.fixed_in_plane]
    return bodies + [PlacedBody(body, np.eye(3), np.zeros(3)) for body in drawing.fixed]
