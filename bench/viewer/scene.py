"""The robot, the ball and the range as shapes for Rerun, with their real dimensions.

All entities are below `scene`, in the golf frame of `sim/impact.py`: X along the target line, Y up, Z to
the right; the origin is on the ground below the point of impact. `scene/robot` is the swing
plane's frame with its origin at the shoulder axis R1; its bodies turn and move in that plane only.
"""

from __future__ import annotations

from math import cos, degrees, pi, sin
from typing import Any

import numpy as np
import rerun as rr

from bench.drawing.placement import ball_at_rest, plane_to_golf
from sim.plant import Site
from sim.robot import RobotParameters
from sim.vectors import Vector

INCH = 0.0254
YARD = 0.9144

STEEL = (92, 104, 120)
ALUMINIUM = (196, 203, 211)
CYLINDER = (38, 112, 178)
ROD = (228, 231, 235)
MOUNT = (235, 153, 40)
SHAFT = (40, 42, 46)
HEAD = (172, 32, 40)
FACE = (214, 216, 220)
STAND = (72, 80, 92)
GRASS = (96, 143, 82)
RANGE = (108, 156, 92)
MAT = (84, 98, 92)
LINE = (250, 250, 245)
TEE = (240, 196, 110)
BALL = (255, 255, 255)
PLANE = (88, 110, 140)

_SOLID = rr.components.FillMode.Solid
_ALONG_X = rr.Quaternion(xyzw=(0.0, sin(pi / 4), 0.0, cos(pi / 4)))
"""Rotation of a cylinder's axis from z to x."""


def log_static_scene(
    recording: rr.RecordingStream, robot: RobotParameters, site: Site, radius: float
) -> None:
    """Log all shapes; `radius` is the ball's (m)."""
    axes, origin = plane_to_golf(robot, site)

    def log(path: str, *shapes: Any) -> None:
        recording.log(f"scene/{path}", *shapes, static=True)

    log("", rr.ViewCoordinates.RIGHT_HAND_Y_UP)
    log("robot", rr.Transform3D(translation=origin, mat3x3=axes))
    _log_bodies(log, robot)
    _log_plane(log, robot, site)
    _log_stand(log, axes, origin)
    rest = ball_at_rest(robot, site, radius)
    tee = max(rest[1] - radius, 0.005)
    log("ground", _box((40.0, 0.02, 30.0), (5.0, -0.012, -6.0), GRASS))
    log("mat", _box((2.6, 0.02, 2.6), (0.0, -0.0105, -0.75), MAT))
    log(
        "target_line", rr.LineStrips3D([[[-1.3, 0.002, 0.0], [24.0, 0.002, 0.0]]], colors=[LINE], radii=0.006)
    )
    log("tee", _rod(tee, 0.004, (rest[0], tee / 2, 0.0), TEE, upright=True))
    log("ball", rr.Points3D.from_fields(radii=radius, colors=BALL))
    _log_range(recording)


def _log_bodies(log: Any, robot: RobotParameters) -> None:
    """Log the five bodies, each in its own frame; thickness as in the thesis, offset along z0 for clarity."""
    log(
        "robot/shoulder_link",
        _box((17 * INCH, 2 * INCH, 3 / 8 * INCH), (robot.l62 / 2 - robot.l16, 0, 0), STEEL),
    )
    log("robot/left_arm", _box((24.5 * INCH, 1.5 * INCH, 5 / 8 * INCH), (robot.l23 / 2, 0, 0.03), ALUMINIUM))
    log("robot/wrist_cylinder", _box((0.21, 0.075, 0.03), (robot.l23 - 0.20, 0.0, 0.056), CYLINDER))
    log("robot/right_arm_rod", _rod(0.36, 0.009, (0.18, 0.0, -0.03), ROD))
    log("robot/right_arm_cylinder", _rod(robot.l56, 0.0225, (robot.l56 / 2, 0.0, -0.03), CYLINDER))
    pins = [
        ("shoulder_link", 0.0),
        ("shoulder_link", robot.l12),
        ("shoulder_link", -robot.l16),
        ("left_arm", robot.l23),
    ]
    for number, (body, x) in enumerate(pins):
        log(f"robot/{body}/pin_{number}", _rod(0.1, 0.014, (x, 0.0, 0.0), STAND, along_z=True))
    club = robot.club
    log("robot/club/mount", _box((0.16, 0.036, 0.036), (0.05, 0.0, 0.0), MOUNT))
    log(
        "robot/club/shaft",
        _rod(club.shaft_length, club.shaft_radius, (club.shaft_length / 2, 0.0, 0.0), SHAFT),
    )
    _log_head(log, robot)


def _log_head(log: Any, robot: RobotParameters) -> None:
    """Log a driver's head behind the face's centre, soled on the ground when the shaft points straight down.

    In the club's frame x points down the shaft, y to the target, z from heel to toe within the plane's
    normal; at address the vertical and the horizontal are those turned by the lie about y.
    """
    club = robot.club
    up = np.array([-sin(club.lie), 0.0, cos(club.lie)])
    toe = np.array([cos(club.lie), 0.0, sin(club.lie)])
    ahead = np.array([0.0, 1.0, 0.0])
    normal = cos(club.loft) * ahead + sin(club.loft) * up
    face = np.array([club.length_to_face, 0.0, 0.0])
    turn = np.column_stack([ahead, up, toe])
    log("robot/club/head", rr.Transform3D(translation=face - 0.052 * ahead + 0.004 * up, mat3x3=turn))
    log("robot/club/head", rr.Ellipsoids3D(half_sizes=[(0.05, 0.029, 0.058)], colors=HEAD, fill_mode=_SOLID))
    tilted = np.column_stack([normal, np.cross(toe, normal), toe])
    log("robot/club/face", rr.Transform3D(translation=face - 0.003 * normal, mat3x3=tilted))
    log("robot/club/face", rr.Ellipsoids3D(half_sizes=[(0.003, 0.026, 0.046)], colors=FACE, fill_mode=_SOLID))


def _log_plane(log: Any, robot: RobotParameters, site: Site) -> None:
    """Log the swing plane, tilted by the lie angle: its frame above the ground and the head's reach."""
    side, top, reach = 1.9, 1.9, robot.l12 + robot.l23 + robot.club.length_to_face
    frame = [(-side, site.ground), (side, site.ground), (side, top), (-side, top), (-side, site.ground)]
    turn = np.linspace(0.0, 2.0 * pi, 145)
    circle = reach * np.column_stack([np.cos(turn), np.sin(turn)])
    inside = circle[circle[:, 1] > site.ground]
    first = int(np.argmax(np.diff(np.append(np.arctan2(inside[:, 0], -inside[:, 1]), 9.0))))
    arc = np.roll(inside, -first - 1, axis=0)
    strips = [[(x, y, -0.02) for x, y in line] for line in (frame, arc)]
    log("robot/plane", rr.LineStrips3D(strips, radii=0.004, colors=[PLANE]))
    words = rr.Points3D(
        [(0.0, top, -0.02)],
        labels=[f"swing plane, {degrees(robot.lie):.0f}°"],
        radii=0.004,
        colors=[LINE],
        show_labels=True,
    )
    log("robot/plane/label", words)


def _log_stand(log: Any, axes: np.ndarray, origin: np.ndarray) -> None:
    """Log a stand behind the swing plane that carries the shoulder axis and its vane drive."""
    drive = axes @ np.array([0.0, 0.0, -0.11]) + origin
    behind = axes @ np.array([0.0, 0.0, -0.2]) + origin
    log("robot/drive", _rod(0.16, 0.075, (0.0, 0.0, -0.13), CYLINDER, along_z=True))
    strips = [
        [behind, (x, 0.0, behind[2] + z)] for x, z in ((origin[0] - 0.45, 0.25), (origin[0] + 0.45, 0.25))
    ]
    strips += [[behind, (origin[0], 0.0, behind[2] - 0.7)], [drive, behind]]
    log("stand", rr.LineStrips3D(strips, radii=0.028, colors=[STAND]))


def _log_range(recording: rr.RecordingStream) -> None:
    """Log the driving range: grass and a line every 50 yards with its distance."""

    def log(path: str, *shapes: Any) -> None:
        recording.log(f"range/{path}", *shapes, static=True)

    recording.log("range", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
    length, width = 330 * YARD, 70 * YARD
    log("grass", _box((length, 0.1, width), (length / 2 - 10, -0.25, 0.0), RANGE))
    marks = range(50, 301, 50)
    lines = [[(d * YARD, 0.0, -width / 2), (d * YARD, 0.0, width / 2)] for d in marks]
    log("lines", rr.LineStrips3D(lines, radii=rr.Radius.ui_points(1.0), colors=[LINE]))
    log(
        "target_line",
        rr.LineStrips3D([[(0, 0, 0), (length - 12, 0, 0)]], radii=rr.Radius.ui_points(1.0), colors=[LINE]),
    )
    labels = rr.Points3D(
        [(d * YARD, 0.0, width / 2) for d in marks[1::2]],
        labels=[f"{d} yd" for d in marks[1::2]],
        show_labels=True,
        radii=rr.Radius.ui_points(1.5),
        colors=[LINE],
    )
    log("distances", labels)


def _box(size: Vector, centre: Vector, colour: tuple[int, int, int]) -> rr.Boxes3D:
    return rr.Boxes3D(sizes=[size], centers=[centre], colors=[colour], fill_mode=_SOLID)


def _rod(
    length: float,
    radius: float,
    centre: Vector,
    colour: tuple[int, int, int],
    along_z: bool = False,
    upright: bool = False,
) -> rr.Cylinders3D:
    """A cylinder along x, or along z, or upright (along y)."""
    upwards = rr.Quaternion(xyzw=(sin(pi / 4), 0.0, 0.0, cos(pi / 4)))
    turn = rr.Quaternion(xyzw=(0.0, 0.0, 0.0, 1.0)) if along_z else upwards if upright else _ALONG_X
    return rr.Cylinders3D(
        lengths=[length],
        radii=[radius],
        centers=[centre],
        quaternions=[turn],
        colors=[colour],
        fill_mode=_SOLID,
    )
