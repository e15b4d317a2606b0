"""Meshes as binary STL, which every URDF reader takes."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from bench.drawing.mesh import Mesh
from bench.telemetry.whole_file import whole_file

_FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("unused", "<u2")])


def write_stl(path: Path, mesh: Mesh) -> None:
    """Write `mesh` (m) to `path`. Raises NotStored."""
    corners = mesh.vertices[mesh.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets = np.zeros(len(corners), _FACET)
    facets["normal"] = across / np.linalg.norm(across, axis=1)[:, None]
    facets["corners"] = corners
    with whole_file(path) as stream:
        stream.write(b"golfbench, m".ljust(80) + struct.pack("<I", len(facets)) + facets.tobytes())
