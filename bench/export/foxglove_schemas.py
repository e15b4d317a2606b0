"""JSON Schemas of the well-known messages of Foxglove's line of viewers that an export uses.

Their parser takes one type a property, no references, and enumerations as alternatives of number constants
with titles. Parts of the messages that an export does not use (meshes, texts, arrows) are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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
