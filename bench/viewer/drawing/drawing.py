"""All drawn bodies of a configured robot, with vane drive, stand, tee and guard, and their positions.

The golf frame is that of `sim/impact.py`: X along the target line, Y up, Z to the right; the origin is on the
ground below the point of impact.
"""

from __future__ import annotations

from math import cos, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import BenchError
from bench.viewer.drawing.bodies import (
    BALL,
    CYLINDER,
    FRAME,
    GUARD,
    STEEL,
    TEE,
    Bar,
    DrawnBody,
    Ellipsoid,
    Mesh,
    Part,
    Tube,
    placed_mesh,
    vector,
)
from bench.viewer.drawing.links import (
    GAP,
    club_body,
    layers_of,
    left_arm,
    right_arm_cylinder,
    right_arm_rod,
    shoulder_link,
    wrist_rod,
)
from sim.kinematics import UnreachablePose, inverse_kinematics, joint_positions
from sim.plant import PlantParameters, Site
from sim.robot import RobotParameters

Array = NDArray[np.float64]


def plane_to_golf(robot: RobotParameters, site: Site) -> tuple[Array, Array]:
    """Return (axes, origin): golf = axes @ (x, y, z of the swing plane) + origin; (3, 3) and (3,) m."""
    c, s = cos(robot.lie), sin(robot.lie)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, s, c], [0.0, -c, s]])
    contact = np.array([0.0, (site.ball_y - site.ground) * s, 0.0])
    return axes, contact - axes @ np.array([site.ball_x, site.ball_y, 0.0])


def ball_at_rest(robot: RobotParameters, site: Site, radius: float) -> Array:
    """Return the centre of the ball on its tee in the golf frame (m): ahead of the face that meets it."""
    height = (site.ball_y - site.ground) * sin(robot.lie)
    return np.array([radius * cos(robot.club.loft), height + radius * sin(robot.club.loft), 0.0])


def body_poses(plant: PlantParameters, q: Array) -> dict[str, tuple[Array, Array]]:
    """Return each moving body's (translations (n, 3) m, quaternions xyzw (n, 4)) in the swing plane."""
    r1, r2, r3, r6, _ = np.moveaxis(joint_positions(plant.robot, q), -2, 0)
    theta1, theta12, theta_t = np.cumsum(q, axis=1).T
    right_arm = np.arctan2(*(r6 - r3).T[::-1])
    along = np.column_stack([np.cos(theta12), np.sin(theta12)])
    way = plant.wrist_stroke(q[:, 2])
    placed = {
        "shoulder_link": (r1, theta1),
        "left_arm": (r2, theta12),
        "wrist_rod": (r2 + way[:, None] * along, theta12),
        "club": (r3, theta_t),
        "right_arm_rod": (r3, right_arm),
        "right_arm_cylinder": (r6, right_arm + pi),
    }
    return {name: (_in_space(point), _about_z(angle)) for name, (point, angle) in placed.items()}


def _in_space(points: Array) -> Array:
    return np.column_stack([points, np.zeros(len(points))])


def _about_z(angle: Array) -> Array:
    half, nothing = angle / 2, np.zeros_like(angle)
    return np.column_stack([nothing, nothing, np.sin(half), np.cos(half)])


def address(plant: PlantParameters) -> Array:
    """Return joint angles (rad) with the face at the ball and the shaft straight down the swing plane.

    Raises:
        BenchError: the arm cannot put it there.
    """
    site = plant.site
    try:
        q = inverse_kinematics(plant.robot, [site.ball_x, site.ball_y, -pi / 2])
    except UnreachablePose as error:
        raise BenchError(
            "plant.site", str(error), "a ball within the arm's reach", "Correct ball_x or ball_y."
        ) from None
    middle = (plant.wrist.lower + plant.wrist.upper) / 2
    q[2] += 2 * pi * round((middle - q[2]) / (2 * pi))
    return q


AXLE = 0.015
"""Radius of the shoulder's axle (m)."""
_VANE_WIDTH, _VANE_HUB, _HOUSING = 0.14, 0.030, 0.010
_STRUT, _STRUT_WALL = 0.028, 0.003
_POST = 0.040
_ROOM = 0.30
"""Between the club's reach and the guard (m)."""
_FRONT = 0.60
"""Guard's front side beyond the target line (m)."""


def drive(plant: PlantParameters) -> DrawnBody:
    """Return the vane drive in the swing plane's frame; its radius gives the configured volume per angle."""
    front = layers_of(plant).drive
    area = max(plant.shoulder.area_a, plant.shoulder.area_b)
    radius = sqrt(2 * area / _VANE_WIDTH + _VANE_HUB**2) + _HOUSING
    back = front - _VANE_WIDTH - 2 * _HOUSING
    return DrawnBody(
        "drive",
        (
            Part("vane drive", Tube((0.0, 0.0, back), (0.0, 0.0, front), radius), CYLINDER),
            Part("axle R1", Tube((0.0, 0.0, front), (0.0, 0.0, 2 * GAP), AXLE), STEEL, joint=True),
        ),
    )


def stand(plant: PlantParameters) -> DrawnBody:
    """Return the stand in the golf frame: three legs under the drive, behind the swing plane."""
    axes, origin = plane_to_golf(plant.robot, plant.site)
    front = layers_of(plant).drive
    top = axes @ np.array([0.0, 0.0, front - _VANE_WIDTH - 2 * _HOUSING]) + origin
    saddle = axes @ np.array([0.0, 0.0, front - _VANE_WIDTH - 2 * _HOUSING - 0.08]) + origin
    feet = [(origin[0] + x, 0.0, saddle[2] + z) for x, z in ((-0.45, 0.25), (0.45, 0.25), (0.0, -0.70))]
    legs = [Tube(vector(saddle), vector(np.array(foot)), _STRUT, _STRUT - _STRUT_WALL) for foot in feet]
    plates = [Bar((0.12, 0.01, 0.12), (float(x), 0.005, float(z))) for x, _, z in feet]
    return DrawnBody(
        "stand",
        (
            Part("saddle", Tube(vector(top), vector(saddle), 0.05), FRAME),
            *(Part(f"leg {number}", leg, FRAME) for number, leg in enumerate(legs, 1)),
            *(Part(f"foot {number}", plate, FRAME) for number, plate in enumerate(plates, 1)),
        ),
    )


def tee(plant: PlantParameters) -> DrawnBody:
    """Return the tee in the golf frame, from the ground to the ball."""
    rest, radius = ball_at_rest(plant.robot, plant.site, plant.ball.radius), plant.ball.radius
    x, top = float(rest[0]), max(float(rest[1]) - radius, 0.005)
    return DrawnBody("tee", (Part("tee", Tube((x, 0.0, 0.0), (x, top, 0.0), 0.004), TEE),))


def ball(plant: PlantParameters) -> DrawnBody:
    """Return the ball at rest in the golf frame."""
    radius, centre = plant.ball.radius, vector(ball_at_rest(plant.robot, plant.site, plant.ball.radius))
    return DrawnBody("ball", (Part("ball", Ellipsoid((radius,) * 3, centre), BALL),))


def guard(plant: PlantParameters) -> DrawnBody:
    """Return posts and rails of the guard in the golf frame, round the club's reach; open to the target."""
    robot, site = plant.robot, plant.site
    _, origin = plane_to_golf(robot, site)
    reach = robot.l12 + robot.l23 + robot.club.length_to_face + _ROOM
    left, right = float(origin[0]) - reach, float(origin[0]) + reach
    back, front = float(origin[2]) - reach * cos(robot.lie), _FRONT
    top = float(origin[1]) + reach * sin(robot.lie)
    posts = [Bar((_POST, top, _POST), (x, top / 2, z)) for x in (left, right) for z in (back, front)]
    low, middle, high = _POST / 2, top / 2, top - _POST / 2
    wide, deep = (right - left, _POST, _POST), (_POST, _POST, front - back)
    # The front is the door: no rail across.
    rails = [Bar(wide, ((left + right) / 2, height, back)) for height in (low, middle, high)]
    rails += [Bar(wide, ((left + right) / 2, height, front)) for height in (low, high)]
    rails += [Bar(deep, (left, height, (back + front) / 2)) for height in (low, middle, high)]
    return DrawnBody(
        "guard",
        (
            *(Part(f"post {number}", post, GUARD) for number, post in enumerate(posts, 1)),
            *(Part(f"rail {number}", rail, GUARD) for number, rail in enumerate(rails, 1)),
        ),
    )


class Drawing(NamedTuple):
    """Bodies by the frame they are drawn in."""

    moving: tuple[DrawnBody, ...]
    """Each in its own frame, placed by `body_poses`."""
    fixed_in_plane: tuple[DrawnBody, ...]
    """Fixed bodies in the swing plane's frame."""
    fixed: tuple[DrawnBody, ...]
    """Fixed bodies in the golf frame."""


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
