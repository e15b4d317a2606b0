"""MCAP, the container of robotics, for Foxglove's line of viewers and PlotJuggler; all channels are JSON.

Frames of Foxglove's 3D panel: `world`, Z up, X along the target line, on the ground below the point of
impact; in it `golf`, the frame of `sim/impact.py`; in it `plane`, the swing plane's; in it the bodies'.

The JSON Schemas are those of the well-known messages of Foxglove's line of viewers. Their parser takes one
type a property, no references, and enumerations as alternatives of number constants with titles. Parts of
the messages that an export does not use (meshes, texts, arrows) are left out.

`/cycle`   a message a cycle. Vectors are objects by component, so that a plot names `/cycle.angle.wrist`
`/tf`      frames of the robot's bodies, each cycle while it is fast, else every tenth
`/scene`   shapes of robot, ball and ground in these frames, once
`/log`     changes of the state and the cause of a stop

The schema of `/cycle` carries each value's unit and description and the names of its codes; the metadata
record `golfbench` is the record's own. JSON has no NaN: an unknown number is left out of its message. It is
not null, which would make its type a union: viewers of Foxglove's line refuse a channel whose schema has one.
Time stamps are UTC if the record has its time, else from zero. A layout is stored in the same folder.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from importlib import resources
from importlib.metadata import version
from math import isfinite, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from bench.records.shot.recorded_shot import recorded_shot
from bench.records.telemetry.atomic_file import atomic_file
from bench.records.telemetry.cycle_record import FIELDS, SCHEMA_VERSION, Field
from bench.records.telemetry.enumerations import ENUMERATIONS
from bench.viewer.drawing.drawing import ball_at_rest, body_poses, plane_to_golf
from bench.viewer.export.record_files import ExportRecord, changes
from bench.viewer.scene import poses_to_draw
from sim.plant import PlantParameters

Schema = dict[str, Any]

NUMBER: Schema = {"type": "number"}
_INTEGER: Schema = {"type": "integer", "minimum": 0}
_TEXT: Schema = {"type": "string"}
_SWITCH: Schema = {"type": "boolean"}


def record(title: str, properties: Mapping[str, Schema]) -> Schema:
    """Return the schema of an object with exactly the required `properties`."""
    return {"title": title, "type": "object", "properties": dict(properties), "required": list(properties)}


def enumeration(names: Mapping[int, str], **about: str) -> Schema:
    """Return the schema of a code with `names`; `about` are further keys."""
    return {**about, "oneOf": [{"title": name, "const": code} for code, name in names.items()]}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


_TIME = {"sec": _INTEGER, "nsec": _INTEGER | {"maximum": 999_999_999}}
_STAMP, _DURATION = record("time", _TIME), record("duration", _TIME)
_VECTOR = record("foxglove.Vector3", dict.fromkeys("xyz", NUMBER))
_POINT = record("foxglove.Point3", dict.fromkeys("xyz", NUMBER))
_QUATERNION = record("foxglove.Quaternion", dict.fromkeys("xyzw", NUMBER))
_COLOUR = record("foxglove.Color", dict.fromkeys("rgba", NUMBER))
_POSE = record("foxglove.Pose", {"position": _VECTOR, "orientation": _QUATERNION})
_SOLID = {"pose": _POSE, "size": _VECTOR}
_LINE = {
    "type": enumeration({0: "LINE_STRIP", 1: "LINE_LOOP", 2: "LINE_LIST"}, title="foxglove.LineType"),
    "pose": _POSE,
    "thickness": NUMBER,
    "scale_invariant": _SWITCH,
    "points": _list(_POINT),
    "color": _COLOUR,
    "colors": _list(_COLOUR),
    "indices": _list(_INTEGER),
}
_ENTITY = {
    "timestamp": _STAMP,
    "frame_id": _TEXT,
    "id": _TEXT,
    "lifetime": _DURATION,
    "frame_locked": _SWITCH,
    "metadata": _list(record("foxglove.KeyValuePair", {"key": _TEXT, "value": _TEXT})),
    "cubes": _list(record("foxglove.CubePrimitive", {**_SOLID, "color": _COLOUR})),
    "spheres": _list(record("foxglove.SpherePrimitive", {**_SOLID, "color": _COLOUR})),
    "cylinders": _list(
        record(
            "foxglove.CylinderPrimitive",
            {**_SOLID, "bottom_scale": NUMBER, "top_scale": NUMBER, "color": _COLOUR},
        )
    ),
    "lines": _list(record("foxglove.LinePrimitive", _LINE)),
}
_DELETION = {
    "timestamp": _STAMP,
    "type": enumeration({0: "MATCHING_ID", 1: "ALL"}, title="foxglove.SceneEntityDeletionType"),
    "id": _TEXT,
}
_TRANSFORM = {
    "timestamp": _STAMP,
    "parent_frame_id": _TEXT,
    "child_frame_id": _TEXT,
    "translation": _VECTOR,
    "rotation": _QUATERNION,
}
_LEVELS = dict(enumerate(("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")))
_LOG = {
    "timestamp": _STAMP,
    "level": enumeration(_LEVELS, title="foxglove.LogLevel"),
    "message": _TEXT,
    "name": _TEXT,
    "file": _TEXT,
    "line": _INTEGER,
}

FRAME_TRANSFORMS = record(
    "foxglove.FrameTransforms", {"transforms": _list(record("foxglove.FrameTransform", _TRANSFORM))}
)
SCENE_UPDATE = record(
    "foxglove.SceneUpdate",
    {
        "deletions": _list(record("foxglove.SceneEntityDeletion", _DELETION)),
        "entities": _list(record("foxglove.SceneEntity", _ENTITY)),
    },
)
LOG = record("foxglove.Log", _LOG)


Message = dict[str, Any]

_STEEL, _ALUMINIUM, _BLUE = (0.36, 0.41, 0.47), (0.77, 0.80, 0.83), (0.15, 0.44, 0.70)
_DARK, _RED, _WHITE, _GRASS = (0.16, 0.16, 0.18), (0.67, 0.13, 0.16), (1.0, 1.0, 1.0), (0.38, 0.56, 0.32)
_UPRIGHT, _ALONG_X = (1 / sqrt(2), 0.0, 0.0, 1 / sqrt(2)), (0.0, 1 / sqrt(2), 0.0, 1 / sqrt(2))
_NO_TURN = (0.0, 0.0, 0.0, 1.0)
_HEAD = (0.1, 0.1, 0.06)


def stamp(nanoseconds: int) -> Message:
    """Return a time since 1970 as messages have it."""
    return {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}


def fixed_frames(plant: PlantParameters, at: int) -> Message:
    """Return the frames that do not move, at `at` (ns)."""
    axes, origin = plane_to_golf(plant.robot, plant.site)
    # The swing plane's axes are the golf frame's, turned about X.
    half = np.arctan2(axes[2, 1], axes[1, 1]) / 2
    turn = (float(np.sin(half)), 0.0, 0.0, float(np.cos(half)))
    return {
        "transforms": [
            _transform(at, "world", "golf", (0.0, 0.0, 0.0), _UPRIGHT),
            _transform(at, "golf", "plane", origin, turn),
        ]
    }


def moving_frames(plant: PlantParameters, angle: np.ndarray, times: Iterable[int]) -> Iterable[Message]:
    """Yield the bodies' frames for joint angles (n, 3) rad at `times` (ns)."""
    poses = body_poses(plant, angle)
    for row, at in enumerate(times):
        yield {
            "transforms": [
                _transform(at, "plane", name, translation[row], quaternion[row])
                for name, (translation, quaternion) in poses.items()
            ]
        }


def scene(plant: PlantParameters, at: int) -> Message:
    """Return all shapes, at `at` (ns); they stay until the end and move with their frames."""
    robot, club = plant.robot, plant.robot.club
    rest = ball_at_rest(robot, plant.site, plant.ball.radius)
    shapes: Mapping[str, tuple[str, Message]] = {
        "shoulder_link": _cube((0.43, 0.05, 0.02), (robot.l62 / 2 - robot.l16, 0.0, 0.0), _STEEL),
        "left_arm": _cube((0.62, 0.04, 0.02), (robot.l23 / 2, 0.0, 0.03), _ALUMINIUM),
        "right_arm_rod": _rod(0.36, 0.009, _WHITE),
        "right_arm_cylinder": _rod(robot.l56, 0.0225, _BLUE),
        "club": _rod(club.shaft_length, club.shaft_radius, _DARK),
    }
    entities = [_entity(at, name, name, {kind: [shape]}) for name, (kind, shape) in shapes.items()]
    kind, head = _cube(_HEAD, (club.length_to_face, -_HEAD[1] / 2, 0.0), _RED)
    entities.append(_entity(at, "club", "head", {kind: [head]}))
    kind, ground = _cube((12.0, 0.02, 8.0), (2.0, -0.012, 0.0), _GRASS)
    entities.append(_entity(at, "golf", "ground", {kind: [ground]}))
    size = _vector((2 * plant.ball.radius,) * 3)
    ball = {"pose": _pose(rest, _NO_TURN), "size": size, "color": _colour(_WHITE)}
    entities.append(_entity(at, "golf", "ball", {"spheres": [ball]}))
    entities.append(_entity(at, "golf", "target line", {"lines": [_target_line()]}))
    return {"deletions": [], "entities": entities}


def _entity(at: int, frame: str, name: str, shapes: Mapping[str, list[Message]]) -> Message:
    entity = {
        "timestamp": stamp(at),
        "frame_id": frame,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": True,
        "metadata": [],
    }
    return entity | {kind: shapes.get(kind, []) for kind in ("cubes", "spheres", "cylinders", "lines")}


def _transform(at: int, parent: str, child: str, translation: Any, rotation: Any) -> Message:
    return {
        "timestamp": stamp(at),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": _vector(translation),
        "rotation": _quaternion(rotation),
    }


def _cube(
    size: tuple[float, ...], centre: tuple[float, ...], colour: tuple[float, ...]
) -> tuple[str, Message]:
    return "cubes", {"pose": _pose(centre, _NO_TURN), "size": _vector(size), "color": _colour(colour)}


def _rod(length: float, radius: float, colour: tuple[float, ...]) -> tuple[str, Message]:
    """Return a cylinder along x that begins at the frame's origin."""
    return "cylinders", {
        "pose": _pose((length / 2, 0.0, 0.0), _ALONG_X),
        "size": _vector((2 * radius, 2 * radius, length)),
        "bottom_scale": 1.0,
        "top_scale": 1.0,
        "color": _colour(colour),
    }


def _target_line() -> Message:
    return {
        "type": 0,
        "pose": _pose((0.0, 0.002, 0.0), _NO_TURN),
        "thickness": 0.01,
        "scale_invariant": False,
        "points": [_vector((x, 0.0, 0.0)) for x in (-1.3, 8.0)],
        "color": _colour(_WHITE),
        "colors": [],
        "indices": [],
    }


def _pose(position: Any, orientation: Any) -> Message:
    return {"position": _vector(position), "orientation": _quaternion(orientation)}


def _vector(values: Any) -> Message:
    return dict(zip("xyz", map(float, values), strict=True))


def _quaternion(values: Any) -> Message:
    return dict(zip("xyzw", map(float, values), strict=True))


def _colour(values: tuple[float, ...]) -> Message:
    return dict(zip("rgba", (*values, 1.0), strict=True))


TOPIC = "/cycle"
LAYOUT = "foxglove_layout.json"
"""Name of the layout's file, in this package and next to the exported file."""

_EVERY = 10
"""Every so many ticks the slow robot's frames are written."""
_INFO, _ERROR = 2, 4
"""Levels of `/log`."""


def write_mcap(path: Path, record: ExportRecord) -> list[Path]:
    """Write `record` to `path` and the layout next to it; return both paths.

    Raises:
        NotStored: they cannot be stored.
        ExceptionGroup: one BenchError for each value of its configuration that this program rejects.
    """
    with atomic_file(path) as stream:
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
    with atomic_file(layout) as stream:
        stream.write(resources.files("bench.viewer.export").joinpath(LAYOUT).read_bytes())
    return [path, layout]


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a cycle's message, with the `unit` of each number."""
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
