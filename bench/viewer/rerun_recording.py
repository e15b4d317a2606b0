"""Swings as a Rerun recording: robot motion, ball flight, and all signals on one time axis.

The swings follow one another on `bench_time`; the figures of the shots are also on a separate timeline,
`shot`. `log_shots` logs to any recording stream, `write_recording` to a file. An export (`write_rrd`) also
has every field of the record in its own unit: below `record/`, a row a cycle on `bench_time`; each entity
carries its unit and description, and the record's metadata are properties of the recording.

A measured golfer next to the robot is a stick figure with club, joint angles and head speed on the same
clock. The golfer's plane is turned into the robot's swing plane, and the head's position at the ball is the
ball's: only the difference of the motions remains.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from bench.base.atomic_file import NotStored, atomic_path
from bench.golfer.golfer_file import GolferSwing
from bench.records.shot.recorded_shot import recorded_shot
from bench.records.shot.shot import ShotRecord
from bench.records.shot.strike import SWINGING, time_at_ball
from bench.records.telemetry.cycle_record import FIELDS
from bench.records.telemetry.record_file import SwingRecord
from bench.viewer._scene import COLOURS, Array, Scene, bench_time
from bench.viewer._shots import ShotSeries
from bench.viewer.blueprint import Span, campaign_blueprint, shot_blueprint
from bench.viewer.drawing.drawing import plane_to_golf
from sim.plant import PlantParameters

_BODY = ("trail_shoulder", "lead_shoulder", "lead_arm", "lead_wrist")
_CLUB = ("lead_wrist", "grip", "head")
_COLOUR = COLOURS[3]
_POSE_ROWS = 5
"""Rows of 1 ms between two poses before the downswing."""


def _log_golfer_scene(scene: Scene, golfer: GolferSwing) -> None:
    """Log place, colours and head path of `golfer` once."""
    recording, site = scene.recording, scene.plant.site
    axes, origin = plane_to_golf(scene.plant.robot, site)
    ball = axes @ np.array([site.ball_x, site.ball_y, 0.0]) + origin
    recording.log("scene/golfer", rr.Transform3D(translation=ball, mat3x3=axes), static=True)
    for name, radius in (("body", 0.018), ("club", 0.008)):
        style = rr.LineStrips3D.from_fields(colors=_COLOUR, radii=radius)
        recording.log(f"scene/golfer/{name}", style, static=True)
    head = golfer.position["head"][golfer.top_row :]
    path = rr.LineStrips3D([head], colors=[_COLOUR], radii=0.004)
    recording.log("scene/golfer/head_path", path, static=True)
    label = rr.Points3D([head[0]], labels=[golfer.name], colors=[_COLOUR], radii=0.02, show_labels=True)
    recording.log("scene/golfer/top", label, static=True)
    for entity, names in (
        ("angle_deg/golfer", [f"golfer {joint}" for joint in ("shoulders", "arm", "wrist")]),
        ("golfer_head_speed_mps", ["golfer's club head"]),
    ):
        lines = rr.SeriesLines(names=names, colors=[_COLOUR] * len(names), widths=[1.5] * len(names))
        recording.log(f"signals/{entity}", lines, static=True)


def _log_golfer(scene: Scene, golfer: GolferSwing, start: float, struck: float, at_ball: Array) -> None:
    """Log the motion of `golfer` from `start` to the ball at `struck` (s).

    `at_ball` are the robot's joint angles there (3,), rad: the golfer's are drawn within half a turn of them.
    """
    rows = np.arange(len(golfer.time))
    shown = (rows >= golfer.top_row) | (rows % _POSE_ROWS == 0)
    shown &= golfer.time >= start - struck
    shown &= np.isfinite(np.column_stack(list(golfer.position.values()))).all(axis=1)
    columns = bench_time(struck + golfer.time[shown])
    for name, roles in (("body", _BODY), ("club", _CLUB)):
        chain = [golfer.position[role][shown] for role in roles if role in golfer.position]
        strips = rr.LineStrips3D.columns(strips=list(np.stack(chain, axis=1)))
        scene.recording.send_columns(f"scene/golfer/{name}", columns, strips)
    turns = np.round((at_ball - golfer.angle[-1]) / (2 * np.pi))
    speed = np.linalg.norm(np.gradient(golfer.position["head"], golfer.time, axis=0), axis=1)
    end = bench_time(np.array([struck + 1e-3]))  # interrupts the lines before the next swing
    for entity, values in (
        ("angle_deg/golfer", np.degrees(golfer.angle + 2 * np.pi * turns)),
        ("golfer_head_speed_mps", speed[:, None]),
    ):
        scene.scalars(f"signals/{entity}", columns, values[shown])
        scene.scalars(f"signals/{entity}", end, np.full_like(values[:1], np.nan))


PAUSE = 0.6
"""Time between the end of a flight or swing and the next swing, s."""
_EVERY = 5
"""Cycles between two poses while the robot is slow."""
_LEAD = 0.3
"""Time shown before and after the swing, s."""


class Layout(NamedTuple):
    """Application id and layout of a recording; a viewer keeps one layout per application."""

    application: str
    blueprint: rrb.Blueprint


def layout_for(records: Sequence[ShotRecord]) -> Layout:
    """Return the layout for one shot or for several."""
    if len(records) == 1:
        swing = swing_span(records[0])
        flight = records[0].flight
        landed = swing.end if flight is None else swing.end + float(flight.path[-1, 0])
        return Layout("golfbench_shot", shot_blueprint(swing, landed))
    return Layout("golfbench_campaign", campaign_blueprint())


def swing_span(record: ShotRecord) -> Span:
    """Return the span of the swing in a recording, extended by `_LEAD`; without a swing, all of it."""
    cycles = record.cycles
    if not len(cycles):
        return Span(0.0, 1.0)
    time = cycles["time"] - cycles["time"][0]
    swinging = np.flatnonzero(np.isin(cycles["phase"], SWINGING))
    first, last = (swinging[0], swinging[-1]) if len(swinging) else (0, -1)
    return Span(max(0.0, float(time[first]) - _LEAD), float(time[last]) + _LEAD)


def write_recording(
    path: Path,
    records: Sequence[ShotRecord],
    plant: PlantParameters,
    name: str = "",
    golfer: GolferSwing | None = None,
) -> None:
    """Write the swings and flights of `records` to `path` (.rrd), completely or not at all.

    `golfer` is drawn next to each. Raises NotStored if the file cannot be stored, ValueError if there are no
    records.
    """
    if not records:
        raise ValueError("a recording needs at least one shot")
    with _writing(path, records, name) as recording:
        log_shots(recording, records, plant, golfer=golfer)


def write_rrd(path: Path, record: SwingRecord) -> list[Path]:
    """Write `record` to `path` and return it.

    Raises:
        NotStored: it cannot be stored.
        ExceptionGroup: one BenchError for each value of its configuration that this program rejects.
    """
    shot = recorded_shot(record.cycles, record.metadata, str(record.path))
    with _writing(path, [shot.record], str(record.path)) as recording:
        scene = log_shots(recording, [shot.record], shot.plant)
        metadata = {key: json.dumps(value) for key, value in record.metadata.items()}
        recording.send_property("golfbench", rr.AnyValues(**cast(Any, metadata)))
        if len(record.cycles):
            _log_fields(scene, record.cycles)
    return [path]


def _log_fields(scene: Scene, cycles: np.ndarray[Any, Any]) -> None:
    time = bench_time(cycles["time"] - cycles["time"][0])
    for field in FIELDS:
        entity = f"record/{field.name}"
        rows = cycles[field.name].astype(float).reshape(len(cycles), len(field.columns))
        scene.scalars(entity, time, rows)
        names = rr.SeriesLines(names=list(field.components or (field.name,)))
        facts = rr.AnyValues(unit=field.unit, description=field.text)
        scene.recording.log(entity, names, facts, static=True)


@contextmanager
def _writing(path: Path, records: Sequence[ShotRecord], name: str) -> Iterator[rr.RecordingStream]:
    """Yield a recording for `records`; its file is created completely or not at all. Raises NotStored."""
    with atomic_path(path) as partial:
        layout = layout_for(records)
        recording = rr.RecordingStream(layout.application)
        try:
            recording.save(partial, default_blueprint=layout.blueprint, write_footer=True)
        except RuntimeError as error:  # it writes the layout at once
            raise _incomplete(path, error) from error
        if name:
            recording.send_recording_name(name)
        try:
            yield recording
        finally:
            recording.disconnect()
        _check_whole(partial, path)


def log_shots(
    recording: rr.RecordingStream,
    records: Sequence[ShotRecord],
    plant: PlantParameters,
    progress: Callable[[], None] = lambda: None,
    golfer: GolferSwing | None = None,
) -> Scene:
    """Log the scene, then `records` one after another, each with `golfer`; call `progress` after each."""
    scene = Scene(recording, plant)
    if golfer is not None:
        _log_golfer_scene(scene, golfer)
    series, start = ShotSeries(scene), 0.0
    for record in records:
        if golfer is not None and (passed := impact_time(record, plant)) is not None:
            time, angle = record.cycles["time"], record.cycles["angle"]
            at_ball = np.array([np.interp(passed, time, column) for column in angle.T])
            _log_golfer(scene, golfer, start, start + passed - float(time[0]), at_ball)
        start = _log_shot(scene, series, record, start) + PAUSE
        progress()
    return scene


def _check_whole(written: Path, path: Path) -> None:
    """Read the file's end back: the library writes in its own thread and does not report a full disk."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            RrdReader(written).stream()
        except (OSError, RuntimeError, ValueError, Warning) as error:
            raise _incomplete(path, error) from error


def _incomplete(path: Path, error: Exception) -> NotStored:
    return NotStored(
        str(path),
        f"an incomplete file ({error})",
        "space left on the disk",
        "free some space or name another folder; nothing was stored",
    )


def _log_shot(scene: Scene, series: ShotSeries, record: ShotRecord, start: float) -> float:
    """Log one shot starting at `start` (s); return its end (s)."""
    cycles, end = record.cycles, start
    scene.interrupt(codes=True)
    if len(cycles):
        time = start + (cycles["time"] - cycles["time"][0])
        end = float(time[-1])
        scene.log_limits(time[[0, -1]])
        scene.log_cycles(time, cycles, _EVERY)
    impact = None if record.flight is None else impact_time(record, scene.plant)
    struck = None if impact is None else start + impact - float(cycles["time"][0])
    scene.log_ball(np.array([start]), scene.rest[None])
    return max(end, series.log_shot(record, start, struck))


def impact_time(record: ShotRecord, plant: PlantParameters) -> float | None:
    """Return the time (s of the record) at which the head is at the ball's place, None if it never is."""
    return time_at_ball(plant.robot, record.cycles, plant.site.ball_x)
