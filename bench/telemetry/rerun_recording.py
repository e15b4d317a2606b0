"""Swings as a Rerun recording: the robot moving, the ball's flight, and every signal on one time axis.

Each vector is one entity with several scalars a row: ten times quicker and three times smaller than an
entity a component. The swings follow one another on `bench_time`; the figures of the shots are also on a
timeline of their own, `shot`. Nothing is started and no network is used: the result is a file.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from matplotlib import colormaps
from rerun.chunk import RrdReader

from bench.campaign.head_path import path_to_ball
from bench.campaign.shot import Shot
from bench.campaign.shot_record import ShotRecord
from bench.lifecycle import Phase, Reaction
from bench.telemetry.rerun_blueprint import TIMELINE, blueprint
from bench.telemetry.rerun_scene import ball_at_rest, body_poses, log_static_scene, plane_to_golf
from bench.telemetry.whole_file import NotStored, whole_path
from drivers.base import CHAMBERS, JOINTS
from sim.kinematics import forward_kinematics
from sim.plant import Site
from sim.robot import RobotParameters

APPLICATION = "golfbench"
PAUSE = 0.6
"""Seconds between the end of a flight or swing and the next swing."""

_COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (230, 159, 0))
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
_QUICK = (Phase.DOWNSWING, Phase.COMMITTED, Phase.IMPACT, Phase.FOLLOW_THROUGH)
_BAR = 1e5


def write_recording(
    path: Path,
    records: Sequence[ShotRecord],
    robot: RobotParameters,
    site: Site,
    ball_radius: float = 0.021335,
    name: str = "",
) -> None:
    """Write the swings and flights of `records` to `path` (.rrd), whole or not at all.

    Raises NotStored when the file cannot be stored, ValueError when there are no records.
    """
    if not records:
        raise ValueError("a recording needs at least one shot")
    with whole_path(path) as partial:
        recording = rr.RecordingStream(APPLICATION)
        recording.save(partial, default_blueprint=blueprint(), write_footer=True)
        if name:
            recording.send_recording_name(name)
        log_static_scene(recording, robot, site, ball_radius)
        _log_styles(recording)
        balls = list(dict.fromkeys(record.shot.ball for record in records))
        start = 0.0
        for record in records:
            colour = _COLOURS[balls.index(record.shot.ball) % len(_COLOURS)]
            start = _log_shot(recording, record, robot, site, ball_radius, start, colour) + PAUSE
        recording.disconnect()
        _check_whole(partial, path)


def _check_whole(written: Path, path: Path) -> None:
    """Read the file's end back: the library writes in its own thread and does not tell of a full disk."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            RrdReader(written).stream()
        except (OSError, RuntimeError, ValueError, Warning) as error:
            raise NotStored(
                str(path),
                f"an incomplete file ({error})",
                "space left on the disk",
                "free some space or name another folder; nothing was stored",
            ) from error


def _time(seconds: np.ndarray) -> rr.TimeColumn:
    """Return `seconds` as the recording's time axis, exact to the nanosecond."""
    return rr.TimeColumn(TIMELINE, duration=np.round(seconds * 1e9).astype("timedelta64[ns]"))


def _log_shot(
    recording: rr.RecordingStream,
    record: ShotRecord,
    robot: RobotParameters,
    site: Site,
    ball_radius: float,
    start: float,
    colour: tuple[int, int, int],
) -> float:
    """Log one shot beginning at `start` (s); return when it is over (s)."""
    cycles, end = record.cycles, start
    impact = _impact_time(record, robot, site)
    if len(cycles):
        time = start + (cycles["time"] - cycles["time"][0])
        end = float(time[-1])
        _log_signals(recording, time, cycles, robot)
        _log_motion(recording, time, cycles, robot, site)
    struck = None if impact is None else start + impact - float(cycles["time"][0])
    _log_text(recording, record.shot, start, struck)
    rest = ball_at_rest(robot, site, ball_radius)
    if struck is None or record.flight is None:
        _log_ball(recording, np.array([start]), rest[None])
        return end
    flown = struck + record.flight.path[:, 0]
    _log_flight(recording, record, flown, colour)
    near = record.flight.path[record.flight.path[:, 0] <= 1.0]
    _log_ball(
        recording,
        np.concatenate([[start], struck + near[:, 0]]),
        np.vstack([rest, rest + near[:, 1:] - near[0, 1:]]),
    )
    return max(end, float(flown[-1]))


def _impact_time(record: ShotRecord, robot: RobotParameters, site: Site) -> float | None:
    """Return when the face meets the ball (s of the record), None when it does not or no ball flew."""
    if record.flight is None or not len(record.cycles):
        return None
    path = path_to_ball(robot, record.cycles, site.ball_x, 0.1)
    return None if path is None else float(path.time[-1])


def _log_signals(
    recording: rr.RecordingStream, time: np.ndarray, cycles: np.ndarray[Any, Any], robot: RobotParameters
) -> None:
    """Log the signals at the full rate of the record."""
    pressure = cycles["chamber_pressure"]
    if not np.isfinite(pressure).any():
        pressure = cycles["plant_pressure"]
    signals: dict[str, np.ndarray] = {
        "angle_deg/reference": np.degrees(cycles["reference_angle"]),
        "angle_deg/actual": np.degrees(cycles["angle"]),
        "angle_error_deg": np.degrees(cycles["reference_angle"] - cycles["angle"]),
        "valve/wanted": cycles["desired_valve"],
        "valve/applied": cycles["applied_valve"],
        "pressure_bar": np.column_stack([pressure, cycles["supply_pressure"]]) / _BAR,
        "head_speed_mps": _head_velocity(robot, cycles)[1],
    }
    for name, values in signals.items():
        rows = np.ascontiguousarray(values.reshape(len(time), -1))
        columns = rr.Scalars.columns(scalars=rows.ravel())
        recording.send_columns(
            f"signals/{name}", [_time(time)], columns.partition([rows.shape[1]] * len(time))
        )
    for name, names in (("phase", Phase), ("reaction", Reaction)):
        codes = cycles[name].astype(int)
        changes = np.concatenate([[0], np.flatnonzero(np.diff(codes)) + 1])
        states = rr.StateChange.columns(state=[_state(names(code)) for code in codes[changes]])
        recording.send_columns(f"signals/{name}", [_time(time[changes])], states)


def _state(code: Phase | Reaction) -> str:
    return code.name.lower().replace("_", " ")


def _head_velocity(robot: RobotParameters, cycles: np.ndarray[Any, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the face centre's positions (n, 2) m in the swing plane and speeds (n,) m/s, as estimated."""
    angle, velocity = cycles["angle"], cycles["velocity"]
    step = 1e-6
    ahead = forward_kinematics(robot, angle + step * velocity)[:, :2]
    behind = forward_kinematics(robot, angle - step * velocity)[:, :2]
    return forward_kinematics(robot, angle)[:, :2], np.linalg.norm(ahead - behind, axis=1) / (2 * step)


def _log_motion(
    recording: rr.RecordingStream,
    time: np.ndarray,
    cycles: np.ndarray[Any, Any],
    robot: RobotParameters,
    site: Site,
) -> None:
    """Log the bodies' poses, each cycle where the robot is quick and each fifth elsewhere, and the trace."""
    shown = np.isin(cycles["phase"], _QUICK)
    shown[::5] = True
    for name, (translation, quaternion) in body_poses(robot, cycles["angle"][shown]).items():
        poses = rr.Transform3D.columns(translation=translation, quaternion=quaternion)
        recording.send_columns(f"scene/robot/{name}", [_time(time[shown])], poses)
    axes, origin = plane_to_golf(robot, site)
    head, speed = _head_velocity(robot, cycles)
    points = head[shown] @ axes[:, :2].T + origin
    segments = np.stack([points[:-1], points[1:]], axis=1)
    speeds = (speed[shown][:-1] + speed[shown][1:]) / 2
    colours = (colormaps["turbo"](np.clip(speeds / 50.0, 0, 1) * 0.9 + 0.05)[:, :3] * 255).astype(np.uint8)
    trace = rr.LineStrips3D.columns(
        strips=list(segments), colors=colours, radii=np.full(len(segments), 0.009, np.float32)
    )
    recording.send_columns("scene/trace", [_time(time[shown][1:])], trace)


def _log_ball(recording: rr.RecordingStream, time: np.ndarray, position: np.ndarray) -> None:
    recording.send_columns("scene/ball", [_time(time)], rr.Points3D.columns(positions=position))


def _log_flight(
    recording: rr.RecordingStream, record: ShotRecord, time: np.ndarray, colour: tuple[int, int, int]
) -> None:
    """Log the path, the moving ball with its speed, and where it landed."""
    if record.flight is None:
        return
    path = record.flight.path
    shot = f"range/shots/{record.shot.shot:03d}"
    speed = np.linalg.norm(np.gradient(path[:, 1:], path[:, 0], axis=0), axis=1)
    gap = np.append(time, time[-1] + 1e-3)  # not a number: no line from this flight to the next
    recording.send_columns(
        "signals/ball_speed_mps", [_time(gap)], rr.Scalars.columns(scalars=[*speed, np.nan])
    )
    sparse = np.unique(np.append(np.arange(0, len(path), 4), len(path) - 1))
    recording.send_columns(
        f"{shot}/path",
        [_time(time[:1]), rr.TimeColumn("shot", sequence=[record.shot.shot])],
        rr.LineStrips3D.columns(strips=[path[sparse, 1:]]),
    )
    recording.log(
        f"{shot}/path",
        rr.LineStrips3D.from_fields(colors=colour, radii=rr.Radius.ui_points(1.5)),
        static=True,
    )
    recording.send_columns("range/ball", [_time(time)], rr.Points3D.columns(positions=path[:, 1:]))
    landed = int(np.searchsorted(path[:, 0], record.flight.time))
    landing = path[min(landed, len(path) - 1), 1:]
    recording.send_columns(
        f"{shot}/landing",
        [_time(time[:1] + record.flight.time), rr.TimeColumn("shot", sequence=[record.shot.shot])],
        rr.Points3D.columns(positions=landing[None]),
    )
    recording.log(
        f"{shot}/landing", rr.Points3D.from_fields(colors=colour, radii=rr.Radius.ui_points(4.0)), static=True
    )


def _log_text(recording: rr.RecordingStream, shot: Shot, start: float, struck: float | None) -> None:
    """Log the shot's figures: what is tried at its start, what was measured once the ball is gone."""
    title = f"**Shot {shot.shot}: {shot.ball}**\n"
    before, after = f"{title}\n{shot.club}, swinging", _figures(title, shot)
    times, texts = ([start], [after]) if struck is None else ([start, struck], [before, after])
    recording.send_columns(
        "shot",
        [_time(np.array(times)), rr.TimeColumn("shot", sequence=[shot.shot] * len(times))],
        rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(times)),
    )


def _figures(title: str, shot: Shot) -> str:
    """Return the shot's figures as Markdown."""
    yard, mph = 0.9144, 0.44704
    rows = [
        ("Club", shot.club_speed_mps, 1 / mph, "mph", 1),
        ("Attack", shot.attack_angle_deg, 1, "°", 2),
        ("Ball", shot.ball_speed_mps, 1 / mph, "mph", 1),
        ("Launch", shot.launch_angle_deg, 1, "°", 1),
        ("Spin", shot.spin_rpm, 1, "rpm", 0),
        ("Carry", shot.carry_m, 1 / yard, "yd", 1),
        ("Total", shot.total_m, 1 / yard, "yd", 1),
        ("Apex", shot.apex_m, 1 / yard, "yd", 1),
    ]
    cells = [
        f"{name} | {value * scale:.{digits}f} {unit}"
        for name, value, scale, unit, digits in rows
        if value is not None
    ]
    pairs = [" | ".join(cells[n : n + 2]) for n in range(0, len(cells), 2)]
    table = "\n".join(["| | | | |", "|:--|--:|:--|--:|", *(f"| {pair} |" for pair in pairs)]) if cells else ""
    return f"{title}\n{table}\n\n{shot.status}{': ' + shot.reason if shot.reason else ''}"


def _log_styles(recording: rr.RecordingStream) -> None:
    """Log names, colours and widths of all signals."""
    joint = [_COLOURS[0], _COLOURS[1], _COLOURS[2]]
    chamber = [(0, 114, 178), (86, 180, 233), (213, 94, 0), (240, 150, 90), (0, 130, 95), (90, 200, 160)]

    def lines(
        path: str, names: Sequence[str], colours: Sequence[tuple[int, int, int]], width: float = 1.5
    ) -> None:
        style = rr.SeriesLines(names=list(names), colors=list(colours), widths=[width] * len(names))
        recording.log(f"signals/{path}", style, static=True)

    lines("angle_deg/actual", [f"{name}" for name in JOINTS], joint, 2.0)
    lines("angle_deg/reference", [f"{name} reference" for name in JOINTS], [(150, 155, 165)] * 3, 1.0)
    lines("angle_error_deg", JOINTS, joint)
    lines("valve/applied", JOINTS, joint)
    lines("valve/wanted", [f"{name} wanted" for name in JOINTS], joint, 1.0)
    lines("pressure_bar", [*CHAMBERS, "supply"], [*chamber, (150, 155, 165)])
    lines("head_speed_mps", ["club head"], [(220, 50, 60)], 2.0)
    lines("ball_speed_mps", ["ball"], [(235, 235, 235)], 2.0)
    for name, colour_of in (("phase", _PHASE_COLOURS), ("reaction", _REACTION_COLOURS)):
        states = rr.StateConfiguration(
            values=[_state(code) for code in colour_of], colors=[*colour_of.values()]
        )
        recording.log(f"signals/{name}", states, static=True)
    recording.log(
        "range/ball",
        rr.Points3D.from_fields(radii=rr.Radius.ui_points(4.0), colors=(255, 255, 255)),
        static=True,
    )
