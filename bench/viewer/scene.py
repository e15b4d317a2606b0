"""The drawn robot, ball and range as shapes for Rerun, and their motion.

All entities are below `scene`, in the golf frame of `sim/impact.py`: X along the target line, Y up, Z to the
right; the origin is on the ground below the point of impact. `scene/robot` is the swing plane's frame with
its origin at the shoulder axis R1; its bodies turn and move in that plane only.
"""

from __future__ import annotations

from math import degrees, pi
from typing import Any

import numpy as np
import rerun as rr
from matplotlib import colormaps
from numpy.typing import NDArray

from bench.base.lifecycle import Phase
from bench.viewer.drawing.bodies import DrawnBody
from bench.viewer.drawing.drawing import body_poses, draw, plane_to_golf
from bench.viewer.signals import Array, Cycles, Times
from sim.plant import PlantParameters, Site
from sim.robot import RobotParameters
from sim.vectors import Vector

YARD = 0.9144

GRASS = (96, 143, 82)
RANGE = (108, 156, 92)
MAT = (84, 98, 92)
LINE = (250, 250, 245)
BALL = (255, 255, 255)
PLANE = (88, 110, 140)

_SOLID = rr.components.FillMode.Solid


def log_static_scene(recording: rr.RecordingStream, plant: PlantParameters) -> None:
    """Log all shapes once; from then on the robot's bodies only get poses."""
    robot, site = plant.robot, plant.site
    axes, origin = plane_to_golf(robot, site)

    def log(path: str, *shapes: Any) -> None:
        recording.log(f"scene/{path}", *shapes, static=True)

    log("", rr.ViewCoordinates.RIGHT_HAND_Y_UP)
    log("robot", rr.Transform3D(translation=origin, mat3x3=axes))
    drawing = draw(plant)
    for body in (*drawing.moving, *drawing.fixed_in_plane):
        log(f"robot/{body.name}/drawn", _mesh(body))
    for body in drawing.fixed:
        if body.name != "ball":  # it flies
            log(body.name, _mesh(body))
    _log_plane(log, robot, site)
    log("ground", _box((40.0, 0.02, 30.0), (5.0, -0.012, -6.0), GRASS))
    log("mat", _box((2.6, 0.02, 2.6), (0.0, -0.0105, -0.75), MAT))
    log(
        "target_line", rr.LineStrips3D([[[-1.3, 0.002, 0.0], [24.0, 0.002, 0.0]]], colors=[LINE], radii=0.006)
    )
    log("ball", rr.Points3D.from_fields(radii=plant.ball.radius, colors=BALL))
    _log_range(recording)


def _mesh(body: DrawnBody) -> rr.Mesh3D:
    """Return a drawn body as a mesh, coloured by its parts."""
    mesh = body.mesh
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        vertex_normals=mesh.normals,
        vertex_colors=body.colours,
        triangle_indices=mesh.triangles,
    )


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


MAX_SPEED = 50.0
"""Club head speed shown red in the trace, m/s; blue is standstill."""

_QUICK = (Phase.DOWNSWING, Phase.COMMITTED, Phase.IMPACT, Phase.FOLLOW_THROUGH)
_TRACE_WIDTH = 0.009


def poses_to_draw(cycles: Cycles, every: int) -> NDArray[np.bool_]:
    """Return which cycles are drawn: all while the robot is fast, every `every`-th tick otherwise."""
    shown: NDArray[np.bool_] = np.isin(cycles["phase"], _QUICK) | (cycles["tick"] % every == 0)
    return shown


def log_motion(
    recording: rr.RecordingStream,
    times: Times,
    time: Array,
    cycles: Cycles,
    plant: PlantParameters,
    shown: NDArray[np.bool_],
    before: Array | None = None,
) -> Array | None:
    """Log the bodies' poses and the trace of the head for the cycles `shown`.

    The trace continues from its end `before` (x, y of the swing plane in m, speed in m/s); returns the new
    end.
    """
    if not shown.any():
        return before
    time, cycles = time[shown], cycles[shown]
    columns = times(time)
    for name, (translation, quaternion) in body_poses(plant, cycles["angle"]).items():
        poses = rr.Transform3D.columns(translation=translation, quaternion=quaternion)
        recording.send_columns(f"scene/robot/{name}", columns, poses)
    ways = np.column_stack([cycles["head_position"], cycles["head_speed"]])
    if before is not None:
        ways, time = np.vstack([before, ways]), np.append(time[:1], time)
    if len(ways) > 1:
        axes, origin = plane_to_golf(plant.robot, plant.site)
        points = ways[:, :2] @ axes[:, :2].T + origin
        segments = np.stack([points[:-1], points[1:]], axis=1)
        share = np.clip((ways[:-1, 2] + ways[1:, 2]) / 2 / MAX_SPEED, 0, 1)
        colours = (colormaps["turbo"](share * 0.9 + 0.05)[:, :3] * 255).astype(np.uint8)
        trace = rr.LineStrips3D.columns(
            strips=list(segments), colors=colours, radii=np.full(len(segments), _TRACE_WIDTH, np.float32)
        )
        recording.send_columns("scene/trace", times(time[1:]), trace)
    last: Array = ways[-1]
    return last


def log_ball(recording: rr.RecordingStream, times: Times, time: Array, position: Array) -> None:
    """Log the positions of the ball in the scene, (n, 3) m."""
    recording.send_columns("scene/ball", times(time), rr.Points3D.columns(positions=position))
