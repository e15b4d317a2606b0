"""The robot at address as one binary glTF file (.glb), for people: any browser or 3D program opens it.

One node a body, with its pose; below it one mesh with a primitive for each colour. Metres, Y up, X along the
target line: the golf frame is glTF's own.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.drawing.bodies import Colour, DrawnBody, Part
from bench.drawing.drawing import PlacedBody
from bench.drawing.solids import Mesh, joined_meshes
from bench.telemetry.whole_file import whole_file

_FLOAT, _UNSIGNED = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_GLTF, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942


class _Buffer:
    """The binary chunk with its views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: np.ndarray, kind: str, component: int, target: int) -> int:
        """Append `values`; return the accessor's index."""
        raw = values.tobytes()
        self.views.append(
            {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(raw), "target": target}
        )
        self.data += raw
        accessor = {"bufferView": len(self.views) - 1, "componentType": component, "type": kind}
        accessor |= {"count": len(values)}
        if kind == "VEC3":
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def primitive(self, mesh: Mesh, material: int) -> dict[str, Any]:
        """Append a mesh; return its primitive."""
        position = self.add(mesh.vertices.astype("<f4"), "VEC3", _FLOAT, _VERTICES)
        normal = self.add(mesh.normals.astype("<f4"), "VEC3", _FLOAT, _VERTICES)
        indices = self.add(mesh.triangles.astype("<u4").ravel(), "SCALAR", _UNSIGNED, _INDICES)
        return {
            "attributes": {"POSITION": position, "NORMAL": normal},
            "indices": indices,
            "material": material,
        }


def by_colour(body: DrawnBody) -> dict[Colour, list[Part]]:
    """Return the parts of a body by colour."""
    return {
        colour: [part for part in body.parts if part.material.colour == colour]
        for colour in dict.fromkeys(part.material.colour for part in body.parts)
    }


def _material(colour: Colour) -> dict[str, Any]:
    """Return a dull material; glTF counts colours linearly."""
    linear = [((value / 255 + 0.055) / 1.055) ** 2.4 for value in colour]
    surface = {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.1, "roughnessFactor": 0.6}
    return {"pbrMetallicRoughness": surface}


def gltf(bodies: Sequence[PlacedBody]) -> bytes:
    """Return the bodies as a binary glTF file."""
    colours = list(dict.fromkeys(colour for one in bodies for colour in by_colour(one.body)))
    buffer, meshes, nodes = _Buffer(), [], []
    for one in bodies:
        primitives = [
            buffer.primitive(joined_meshes([part.solid.mesh for part in parts]), colours.index(colour))
            for colour, parts in by_colour(one.body).items()
        ]
        meshes.append({"name": one.body.name, "primitives": primitives})
        nodes.append(
            {
                "name": one.body.name,
                "mesh": len(meshes) - 1,
                "translation": [float(value) for value in one.at],
                "rotation": Rotation.from_matrix(one.turn).as_quat().tolist(),
            }
        )
    content = {
        "asset": {"version": "2.0", "generator": "golfbench"},
        "scene": 0,
        "scenes": [{"name": "golfbench", "nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [_material(colour) for colour in colours],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), _JSON) + text
    chunks += struct.pack("<II", len(buffer.data), _BINARY) + bytes(buffer.data)
    return struct.pack("<III", _GLTF, 2, 12 + len(chunks)) + chunks


def write_gltf(path: Path, bodies: Sequence[PlacedBody]) -> None:
    """Write the bodies to `path`. Raises NotStored."""
    with whole_file(path) as stream:
        stream.write(gltf(bodies))
