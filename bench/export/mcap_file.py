"""MCAP, the container of robotics, for Foxglove's line of viewers and PlotJuggler; all channels are JSON.

`/cycle`   a message a cycle. Vectors are objects by component, so that a plot names `/cycle.angle.wrist`
`/tf`      frames of the robot's bodies, each cycle while it is fast, else every tenth
`/scene`   shapes of robot, ball and ground in these frames, once
`/log`     changes of the state and the cause of a stop

The schema of `/cycle` carries each value's unit and description and the names of its codes; the metadata
record `golfbench` is the record's own. JSON has no NaN: an unknown number is left out of its message. It is
not null, which would make its type a union: viewers of Foxglove's line refuse a channel whose schema has one.
Time stamps are UTC if the record has its time, else from zero. A layout stands beside the file.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from importlib import resources
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from bench.export.foxglove_scene import (
    FRAME_TRANSFORMS,
    LOG,
    SCENE_UPDATE,
    enumeration,
    fixed_frames,
    moving_frames,
    scene,
    stamp,
)
from bench.export.record import ExportRecord, changes
from bench.shot.recorded_shot import recorded_shot
from bench.telemetry.cycle_record import FIELDS, SCHEMA_VERSION, Field
from bench.telemetry.enumerations import ENUMERATIONS
from bench.telemetry.whole_file import whole_file
from bench.viewer.scene import poses_to_draw

TOPIC = "/cycle"
LAYOUT = "foxglove_layout.json"
"""Name of the layout's file, here and beside the exported one."""

_EVERY = 10
"""Every so many ticks the slow robot's frames are written."""
_INFO, _ERROR = 2, 4
"""Levels of `/log`."""


def write_mcap(path: Path, record: ExportRecord) -> list[Path]:
    """Write `record` to `path` and the layout beside it; return both paths.

    Raises:
        NotStored: they cannot be stored.
        ExceptionGroup: of BenchErrors, values of its configuration that this program does not take.
    """
    with whole_file(path) as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(library=f"golfbench {version('golfbench')}")
        schemas = {
            TOPIC: (f"golfbench.Cycle.{SCHEMA_VERSION}", json_schema()),
            "/tf": (FRAME_TRANSFORMS["title"], FRAME_TRANSFORMS),
            "/scene": (SCENE_UPDATE["title"], SCENE_UPDATE),
            "/log": (LOG["title"], LOG),
        }
        channels = {
            topic: writer.register_channel(
                topic, "json", writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
            )
            for topic, (name, schema) in schemas.items()
        }
        for topic, at, number, content in _messages(record):
            message = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
            writer.add_message(channels[topic], at, message, at, number)
        writer.add_metadata("golfbench", {key: json.dumps(value) for key, value in record.metadata.items()})
        writer.finish()  # type: ignore[no-untyped-call]
    layout = path.with_name(LAYOUT)
    with whole_file(layout) as stream:
        stream.write(resources.files("bench.export").joinpath(LAYOUT).read_bytes())
    return [path, layout]


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a cycle's message, with `unit` beside each number."""
    return {
        "title": "golfbench.Cycle",
        "type": "object",
        "properties": {field.name: _property(field) for field in FIELDS},
        "required": [field.name for field in FIELDS if field.components or field.dtype != "f8"],
    }


def _property(field: Field) -> dict[str, Any]:
    if field.names:
        names = {int(code): name for code, name in ENUMERATIONS[field.names].items()}
        return enumeration(names, unit=field.unit, description=field.text)
    kind = {"f8": "number", "?": "boolean"}.get(field.dtype, "integer")
    if not field.components:
        return {"type": kind, "unit": field.unit, "description": field.text}
    units = field.unit.split(", ")
    units = units if len(units) > 1 else units * len(field.components)
    inner = {name: {"type": kind, "unit": unit} for name, unit in zip(field.components, units, strict=True)}
    return {"type": "object", "description": field.text, "properties": inner}


def _messages(record: ExportRecord) -> Iterator[tuple[str, int, int, dict[str, Any]]]:
    """Yield topic, time (ns), sequence and content of all messages."""
    cycles = record.cycles
    if not len(cycles):
        return
    # Two parts: seconds since 1970 have no nanoseconds in a double.
    begin = round(record.begin_utc * 1e6) * 1000
    times = [max(0, begin + round(at * 1e9)) for at in cycles["time"].tolist()]
    plant = recorded_shot(cycles, record.metadata, str(record.path)).plant
    yield "/tf", times[0], 0, fixed_frames(plant, times[0])
    yield "/scene", times[0], 0, scene(plant, times[0])
    for row, at in zip(_rows(record), times, strict=True):
        yield TOPIC, at, max(0, row["tick"]) & 0xFFFFFFFF, row
    shown = np.flatnonzero(poses_to_draw(cycles, _EVERY) & np.isfinite(cycles["angle"]).all(axis=1))
    at_shown = [times[row] for row in shown]
    frames = moving_frames(plant, cycles["angle"][shown], at_shown)
    for number, (at, frame) in enumerate(zip(at_shown, frames, strict=True), 1):
        yield "/tf", at, number, frame
    for number, change in enumerate(changes(cycles)):
        at, level = times[change.row], _ERROR if change.cause else _INFO
        content = {"level": level, "message": change.text, "name": "golfbench", "file": "", "line": 0}
        yield "/log", at, number, {"timestamp": stamp(at), **content}


def _rows(record: ExportRecord) -> Iterator[dict[str, Any]]:
    """Yield the cycles' contents."""
    values = [record.cycles[field.name].tolist() for field in FIELDS]
    for row in zip(*values, strict=True):
        contents = zip(FIELDS, row, strict=True)
        yield {
            field.name: _known(zip(field.components, value, strict=True)) if field.components else value
            for field, value in contents
            if field.components or _is_known(value)
        }


def _known(parts: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    return {name: value for name, value in parts if _is_known(value)}


def _is_known(value: Any) -> bool:
    return not isinstance(value, float) or isfinite(value)
