"""Signals, robot, ball and range as Rerun entities, for recordings and live views.

Below `signals`: each vector is one entity with several scalars a row: ten times faster and a third of the
size of one entity per component. Units stand in the entities' names. Limits are separate entities: lines from
one instant at which they are logged to the next.

Below `scene`: shapes and their motion in the golf frame of `sim/impact.py`: X along the target line, Y up, Z
to the right; the origin is on the ground below the point of impact. `scene/robot` is the swing plane's frame
with its origin at the shoulder axis R1; its bodies turn and move in that plane only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import degrees, pi
from typing import Any

import numpy as np
import rerun as rr
from matplotlib import colormaps
from numpy.typing import NDArray

from bench.base.lifecycle import Phase, Reaction, State
from bench.viewer.drawing.bodies import DrawnBody
from bench.viewer.drawing.drawing import ball_at_rest, body_poses, draw, plane_to_golf
from drivers.base import CHAMBERS, JOINTS
from sim.plant import PlantParameters
from sim.vectors import Vector

Cycles = np.ndarray[Any, Any]
Array = NDArray[np.float64]
Colour = tuple[int, int, int]
Times = Callable[[Array], list[rr.TimeColumn]]
"""Converts times of the recording (s) to its time axes."""

TIMELINE = "bench_time"

COLOURS: tuple[Colour, ...] = (
    (0, 114, 178),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (86, 180, 233),
    (230, 159, 0),
)
"""Colours suitable for colour-blind readers (Okabe and Ito)."""

_LIMIT: Colour = (120, 125, 135)
_STATE_COLOURS = {
    State.STARTING: (107, 114, 128),
    State.ESTOP: (185, 28, 28),
    State.SAFE: (100, 116, 139),
    State.HOMING: (167, 139, 250),
    State.READY: (21, 128, 61),
    State.ARMED: (234, 179, 8),
    State.SWINGING: (249, 115, 22),
    State.RECOVERING: (99, 132, 235),
    State.ACCESS: (14, 165, 233),
    State.FAULT: (220, 38, 38),
}
_PHASE_COLOURS = {
    Phase.STANDING: (156, 163, 175),
    Phase.HOMING: (167, 139, 250),
    Phase.HOLD: (148, 163, 184),
    Phase.BACKSWING: (99, 132, 235),
    Phase.TOP: (234, 179, 8),
    Phase.DOWNSWING: (74, 190, 110),
    Phase.COMMITTED: (21, 128, 61),
    Phase.IMPACT: (220, 38, 38),
    Phase.FOLLOW_THROUGH: (249, 146, 60),
    Phase.RETURN: (120, 130, 145),
}
_REACTION_COLOURS = {
    Reaction.NONE: (75, 85, 99),
    Reaction.COMPLETE: (234, 179, 8),
    Reaction.BRAKE: (249, 115, 22),
    Reaction.BLIND_BRAKE: (220, 38, 38),
    Reaction.PASSIVE: (168, 85, 247),
    Reaction.VENT: (14, 165, 233),
}
CODES = (("state", _STATE_COLOURS), ("phase", _PHASE_COLOURS), ("reaction", _REACTION_COLOURS))
"""Coded fields of the cycle that are shown as a state timeline, with the colours of their codes."""

_BAR, _MICRO = 1e5, 1e-6


def bench_time(seconds: Array) -> list[rr.TimeColumn]:
    """Return `seconds` as the recording's time axis, exact to the nanosecond."""
    return [rr.TimeColumn(TIMELINE, duration=np.round(seconds * 1e9).astype("timedelta64[ns]"))]


def signals_of(cycles: Cycles, plant: PlantParameters) -> dict[str, Array]:
    """Return the signals drawn of `cycles`, by entity below `signals`, as arrays (n, m)."""
    pressure = chamber_pressure(cycles)
    effort = efforts(cycles, plant)
    return {
        "angle_deg/reference": np.degrees(cycles["reference_angle"]),
        "angle_deg/actual": np.degrees(cycles["angle"]),
        "angle_error_deg": np.degrees(cycles["reference_angle"] - cycles["angle"]),
        "effort_nm": effort[:, [0, 2]],
        "effort_n": effort[:, [1]],
        "valve/wanted": cycles["desired_valve"],
        "valve/applied": cycles["applied_valve"],
        "valve/measured": cycles["spool_position"],
        "pressure_bar": np.column_stack([pressure, cycles["supply_pressure"]]) / _BAR,
        "head_speed_mps": cycles["head_speed"][:, None],
        "tick_us": np.column_stack([cycles["wake_latency"], cycles["work_time"]]) / _MICRO,
    }


def limits_of(plant: PlantParameters) -> dict[str, Array]:
    """Return the limits drawn with the signals, by entity below `signals`: (m,) in the unit of the name."""
    torque, force, wrist = effort_limits(plant)
    ratings = [actuator.pressure_rating for actuator in plant.actuators]
    return {
        "valve/limits": np.array([-1.0, 1.0]),
        "effort_nm/limits": np.array([-torque, torque, -wrist, wrist]),
        "effort_n/limits": np.array([-force, force]),
        "pressure_bar/limits": np.array([min(ratings)]) / _BAR,
        "tick_us/limits": np.array([plant.tick / _MICRO]),
    }


def chamber_pressure(cycles: Cycles) -> Array:
    """Return the chambers' pressures (n, 6) Pa: measured where fitted, else the simulation's, else NaN."""
    measured: Array = cycles["chamber_pressure"]
    return measured if np.isfinite(measured).any() else cycles["plant_pressure"]


def efforts(cycles: Cycles, plant: PlantParameters) -> Array:
    """Return the actuator efforts (n, 3) from chamber pressures (N m, N, N m); NaN for unknown pressures."""
    pressure = chamber_pressure(cycles)
    air = plant.supply.atmosphere
    forces = np.stack(
        [
            actuator.area_a * (pressure[:, 2 * k] - air) - actuator.area_b * (pressure[:, 2 * k + 1] - air)
            for k, actuator in enumerate(plant.actuators)
        ],
        axis=1,
    )
    forces[:, 2] *= plant.wrist_slope(cycles["angle"][:, 2])
    return forces


def effort_limits(plant: PlantParameters) -> tuple[float, float, float]:
    """Return the max efforts at supply pressure without friction (N m, N, N m)."""
    gauge = plant.supply.pressure - plant.supply.atmosphere
    shoulder, arm, wrist = (max(a.area_a, a.area_b) * gauge for a in plant.actuators)
    return shoulder, arm, wrist * plant.wrist_lever


def _label(code: Any) -> str:
    return str(code.name).lower().replace("_", " ")


def _log_styles(recording: rr.RecordingStream) -> None:
    """Log names, colours and widths of all signals; static, so that late viewers get them too."""
    joint = COLOURS[:3]
    chamber = [(0, 114, 178), (86, 180, 233), (213, 94, 0), (240, 150, 90), (0, 130, 95), (90, 200, 160)]

    def lines(path: str, names: Sequence[str], colours: Sequence[Colour], width: float = 1.5) -> None:
        style = rr.SeriesLines(names=list(names), colors=list(colours), widths=[width] * len(names))
        recording.log(f"signals/{path}", style, static=True)

    def limits(path: str, names: Sequence[str], colours: Sequence[Colour]) -> None:
        lines(f"{path}/limits", names, colours, 0.75)

    lines("angle_deg/actual", JOINTS, joint, 2.0)
    lines("angle_deg/reference", [f"{name} reference" for name in JOINTS], [(150, 155, 165)] * 3, 1.0)
    lines("angle_error_deg", JOINTS, joint)
    lines("effort_nm", [f"{JOINTS[0]} N·m", f"{JOINTS[2]} N·m"], [joint[0], joint[2]])
    limits("effort_nm", ["shoulder −", "shoulder +", "wrist −", "wrist +"], [joint[0]] * 2 + [joint[2]] * 2)
    lines("effort_n", [f"{JOINTS[1]} N"], [joint[1]])
    limits("effort_n", ["min", "max"], [_LIMIT] * 2)
    lines("valve/applied", JOINTS, joint)
    lines("valve/wanted", [f"{name} wanted" for name in JOINTS], joint, 1.0)
    lines("valve/measured", [f"{name} measured" for name in JOINTS], joint, 1.0)
    limits("valve", ["shut", "open"], [_LIMIT] * 2)
    lines("pressure_bar", [*CHAMBERS, "supply"], [*chamber, (150, 155, 165)])
    limits("pressure_bar", ["rating"], [(220, 50, 60)])
    lines("head_speed_mps", ["club head"], [(220, 50, 60)], 2.0)
    lines("ball_speed_mps", ["ball"], [(235, 235, 235)], 2.0)
    lines("tick_us", ["late by", "work"], [COLOURS[1], COLOURS[4]], 1.0)
    limits("tick_us", ["period"], [(220, 50, 60)])
    for name, colour_of in CODES:
        states = rr.StateConfiguration(values=list(map(_label, colour_of)), colors=[*colour_of.values()])
        recording.log(f"signals/{name}", states, static=True)


# Robot, ball and range -------------------------------------------------------------------------------

_YARD = 0.9144

_GRASS = (96, 143, 82)
_RANGE = (108, 156, 92)
_MAT = (84, 98, 92)
_LINE = (250, 250, 245)
_BALL = (255, 255, 255)
_PLANE = (88, 110, 140)


def _log_scene(recording: rr.RecordingStream, plant: PlantParameters) -> None:
    """Log all shapes once; from then on the robot's bodies only get poses."""
    axes, origin = plane_to_golf(plant.robot, plant.site)

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
    _log_plane(log, plant)
    log("ground", _box((40.0, 0.02, 30.0), (5.0, -0.012, -6.0), _GRASS))
    log("mat", _box((2.6, 0.02, 2.6), (0.0, -0.0105, -0.75), _MAT))
    line = [[-1.3, 0.002, 0.0], [24.0, 0.002, 0.0]]
    log("target_line", rr.LineStrips3D([line], colors=[_LINE], radii=0.006))
    log("ball", rr.Points3D.from_fields(radii=plant.ball.radius, colors=_BALL))


def _mesh(body: DrawnBody) -> rr.Mesh3D:
    mesh = body.mesh
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        vertex_normals=mesh.normals,
        vertex_colors=body.colours,
        triangle_indices=mesh.triangles,
    )


def _log_plane(log: Any, plant: PlantParameters) -> None:
    """Log the swing plane, tilted by the lie angle: its frame above the ground and the head's reach."""
    robot, ground = plant.robot, plant.site.ground
    side, top, reach = 1.9, 1.9, robot.l12 + robot.l23 + robot.club.length_to_face
    frame = [(-side, ground), (side, ground), (side, top), (-side, top), (-side, ground)]
    turn = np.linspace(0.0, 2.0 * pi, 145)
    circle = reach * np.column_stack([np.cos(turn), np.sin(turn)])
    inside = circle[circle[:, 1] > ground]
    first = int(np.argmax(np.diff(np.append(np.arctan2(inside[:, 0], -inside[:, 1]), 9.0))))
    arc = np.roll(inside, -first - 1, axis=0)
    strips = [[(x, y, -0.02) for x, y in line] for line in (frame, arc)]
    log("robot/plane", rr.LineStrips3D(strips, radii=0.004, colors=[_PLANE]))
    log("robot/plane/label", _words([(0.0, top, -0.02)], [f"swing plane, {degrees(robot.lie):.0f}°"], 0.004))


def _log_range(recording: rr.RecordingStream) -> None:
    """Log the driving range: grass and a line every 50 yards with its distance."""

    def log(path: str, *shapes: Any) -> None:
        recording.log(f"range/{path}", *shapes, static=True)

    log("", rr.ViewCoordinates.RIGHT_HAND_Y_UP)
    length, width, thin = 330 * _YARD, 70 * _YARD, rr.Radius.ui_points(1.0)
    log("grass", _box((length, 0.1, width), (length / 2 - 10, -0.25, 0.0), _RANGE))
    marks = range(50, 301, 50)
    lines = [[(d * _YARD, 0.0, -width / 2), (d * _YARD, 0.0, width / 2)] for d in marks]
    log("lines", rr.LineStrips3D(lines, radii=thin, colors=[_LINE]))
    log("target_line", rr.LineStrips3D([[(0, 0, 0), (length - 12, 0, 0)]], radii=thin, colors=[_LINE]))
    places = [(d * _YARD, 0.0, width / 2) for d in marks[1::2]]
    log("distances", _words(places, [f"{d} yd" for d in marks[1::2]], rr.Radius.ui_points(1.5)))


def _words(places: Sequence[Vector], words: Sequence[str], radius: Any) -> rr.Points3D:
    return rr.Points3D(places, labels=list(words), radii=radius, colors=[_LINE], show_labels=True)


def _box(size: Vector, centre: Vector, colour: Colour) -> rr.Boxes3D:
    solid = rr.components.FillMode.Solid
    return rr.Boxes3D(sizes=[size], centers=[centre], colors=[colour], fill_mode=solid)


_MAX_SPEED = 50.0
"""Club head speed shown red in the trace, m/s; blue is standstill."""
_QUICK = (Phase.DOWNSWING, Phase.COMMITTED, Phase.IMPACT, Phase.FOLLOW_THROUGH)
_TRACE_WIDTH = 0.009


class Scene:
    """Robot, range and signals of a bench in a recording, static parts logged; `times` are its time axes."""

    def __init__(
        self, recording: rr.RecordingStream, plant: PlantParameters, times: Times = bench_time
    ) -> None:
        self.recording, self.plant, self.times = recording, plant, times
        self.rest = ball_at_rest(plant.robot, plant.site, plant.ball.radius)
        """Centre of the ball on its tee (3,), m."""
        self._codes: dict[str, int] = {}
        self._trace: Array | None = None
        """End of the trace: x, y of the swing plane in m, speed in m/s."""
        _log_scene(recording, plant)
        _log_range(recording)
        _log_styles(recording)

    def interrupt(self, *, codes: bool = False) -> None:
        """Interrupt the trace of the head; with `codes`, also log the codes of the next cycle in any case."""
        self._trace = None
        if codes:
            self._codes = {}

    def log_cycles(self, time: Array, cycles: Cycles, every: int) -> None:
        """Log every row of `cycles` at `time` (s): signals, codes on change, poses and the head's trace.

        A pose is logged at each tick while the robot is fast, at every `every`-th one otherwise.
        """
        columns = self.times(time)
        for name, values in signals_of(cycles, self.plant).items():
            self.scalars(f"signals/{name}", columns, values)
        self._log_codes(time, cycles)
        shown = np.isin(cycles["phase"], _QUICK) | (cycles["tick"] % every == 0)
        if shown.any():
            self._log_motion(time[shown], cycles[shown])

    def log_limits(self, time: Array) -> None:
        """Log the limits at each `time` (s): they are drawn from the first to the last."""
        for name, limits in limits_of(self.plant).items():
            self.scalars(f"signals/{name}", self.times(time), np.tile(limits, (len(time), 1)))

    def log_ball(self, time: Array, position: Array) -> None:
        """Log the positions of the ball in the scene, (n, 3) m."""
        self.recording.send_columns("scene/ball", self.times(time), rr.Points3D.columns(positions=position))

    def scalars(self, entity: str, times: list[rr.TimeColumn], rows: Array) -> None:
        """Send `rows` (n, m) as n rows of m scalars."""
        rows = np.ascontiguousarray(rows)
        columns = rr.Scalars.columns(scalars=rows.ravel())
        self.recording.send_columns(entity, times, columns.partition([rows.shape[1]] * len(rows)))

    def _log_codes(self, time: Array, cycles: Cycles) -> None:
        for name, colours in CODES:
            codes = cycles[name].astype(int)
            changed = np.flatnonzero(np.diff(codes, prepend=self._codes.get(name, -1)))
            self._codes[name] = int(codes[-1])
            if len(changed):
                kind = type(next(iter(colours)))
                words = rr.StateChange.columns(state=[_label(kind(code)) for code in codes[changed]])
                self.recording.send_columns(f"signals/{name}", self.times(time[changed]), words)

    def _log_motion(self, time: Array, cycles: Cycles) -> None:
        columns = self.times(time)
        for name, (translation, quaternion) in body_poses(self.plant, cycles["angle"]).items():
            poses = rr.Transform3D.columns(translation=translation, quaternion=quaternion)
            self.recording.send_columns(f"scene/robot/{name}", columns, poses)
        ways = np.column_stack([cycles["head_position"], cycles["head_speed"]])
        if self._trace is not None:
            ways, time = np.vstack([self._trace, ways]), np.append(time[:1], time)
        self._trace = ways[-1]
        if len(ways) > 1:
            axes, origin = plane_to_golf(self.plant.robot, self.plant.site)
            points = ways[:, :2] @ axes[:, :2].T + origin
            segments = np.stack([points[:-1], points[1:]], axis=1)
            share = np.clip((ways[:-1, 2] + ways[1:, 2]) / 2 / _MAX_SPEED, 0, 1)
            colours = (colormaps["turbo"](share * 0.9 + 0.05)[:, :3] * 255).astype(np.uint8)
            widths = np.full(len(segments), _TRACE_WIDTH, np.float32)
            trace = rr.LineStrips3D.columns(strips=list(segments), colors=colours, radii=widths)
            self.recording.send_columns("scene/trace", self.times(time[1:]), trace)
