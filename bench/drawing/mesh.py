"""Surfaces of solids as triangles, in numpy alone: what viewers, URDF and glTF need; STL files of them."""

from __future__ import annotations

import struct
from math import pi
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.telemetry.whole_file import whole_file
from sim.vectors import Vector

Array = NDArray[np.float64]
Triangles = NDArray[np.uint32]

SEGMENTS = 32
"""Straight pieces of a circle."""


class Mesh(NamedTuple):
    """Vertices (n, 3) m, outward normals (n, 3), triangles (m, 3) counter-clockwise from outside."""

    vertices: Array
    normals: Array
    triangles: Triangles


def joined_meshes(meshes: list[Mesh]) -> Mesh:
    """Return `meshes` as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    triangles = [mesh.triangles + np.uint32(start) for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate(triangles).astype(np.uint32),
    )


def placed_mesh(mesh: Mesh, turn: Any, at: Any) -> Mesh:
    """Return `mesh` turned by the rotation matrix `turn`, then moved by `at` (m)."""
    rotation = np.array(turn)
    return Mesh(mesh.vertices @ rotation.T + np.array(at), mesh.normals @ rotation.T, mesh.triangles)


def _grid(rows: int, columns: int) -> Triangles:
    """Return the triangles of a grid of vertices, row by row."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    corner = (row * columns + column).ravel()
    below, right = corner + columns, corner + 1
    pairs = [np.column_stack([corner, below, right]), np.column_stack([right, below, below + 1])]
    return np.concatenate(pairs).astype(np.uint32)


def _outwards(mesh: Mesh) -> Mesh:
    """Return `mesh` with every triangle turned round that disagrees with its normals."""
    corners = mesh.vertices[mesh.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    wrong = (across * mesh.normals[mesh.triangles].sum(axis=1)).sum(axis=1) < 0
    triangles = mesh.triangles.copy()
    triangles[wrong] = triangles[wrong][:, ::-1]
    return Mesh(mesh.vertices, mesh.normals, triangles[np.linalg.norm(across, axis=1) > 0])


def box_mesh(size: Vector, centre: Vector, turn: Any) -> Mesh:
    """Return a box of `size` (m) about `centre`, turned by `turn`."""
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = side
            one, other = (np.eye(3)[(axis + k) % 3] for k in (1, 2))
            square = [normal + i * one + j * other for i in (-1, 1) for j in (-1, 1)]
            corners = np.array(square) * np.array(size) / 2
            faces.append(Mesh(corners, np.tile(normal, (4, 1)), _grid(2, 2)))
    return placed_mesh(_outwards(joined_meshes(faces)), turn, centre)


def _circle() -> tuple[Array, Array]:
    """Return cosines and sines round a circle, first and last equal."""
    angle = np.linspace(0.0, 2 * pi, SEGMENTS + 1)
    angle[-1] = 0.0
    return np.cos(angle), np.sin(angle)


def _wall(radius: float, length: float, side: float) -> Mesh:
    """Return a cylinder's wall along z from 0 to `length`, seen from outside (`side` 1) or inside (-1)."""
    c, s = _circle()
    rim = np.column_stack([radius * c, radius * s, np.zeros_like(c)])
    normal = np.column_stack([side * c, side * s, np.zeros_like(c)])
    return Mesh(np.vstack([rim, rim + [0, 0, length]]), np.vstack([normal, normal]), _grid(2, len(c)))


def _ring(outer: float, inner: float, height: float, side: float) -> Mesh:
    """Return a flat ring at z = `height` that looks along +z (`side` 1) or -z (-1)."""
    c, s = _circle()
    rims = [np.column_stack([r * c, r * s, np.full_like(c, height)]) for r in (inner, outer)]
    return Mesh(np.vstack(rims), np.tile([0.0, 0.0, side], (2 * len(c), 1)), _grid(2, len(c)))


def tube_mesh(start: Vector, end: Vector, outer: float, inner: float) -> Mesh:
    """Return a tube between two points (m); `inner` 0 is a rod."""
    way = np.array(end) - np.array(start)
    length = float(np.linalg.norm(way))
    axis = way / length
    least = np.eye(3)[int(np.argmin(np.abs(axis)))]
    across = np.cross(least, axis)
    across /= np.linalg.norm(across)
    walls = [_wall(outer, length, 1.0), _ring(outer, inner, 0.0, -1.0), _ring(outer, inner, length, 1.0)]
    if inner > 0:
        walls.append(_wall(inner, length, -1.0))
    turn = np.column_stack([across, np.cross(axis, across), axis])
    return placed_mesh(_outwards(joined_meshes(walls)), turn, start)


def ellipsoid_mesh(half: Vector, centre: Vector, turn: Any, cut: float | None) -> Mesh:
    """Return an ellipsoid, cut flat at `cut` (m) along its first axis; poles lie on that axis."""
    c, s = _circle()
    top = 1.0 if cut is None else min(cut / half[0], 1.0)
    polar = np.linspace(pi, np.arccos(top), SEGMENTS // 2 + 1)
    along, around = np.cos(polar), np.sin(polar)
    around[0] = 0.0
    if top == 1.0:
        around[-1] = 0.0
    unit = np.stack(
        [np.broadcast_to(along[:, None], (len(polar), len(c))), np.outer(around, c), np.outer(around, s)], -1
    ).reshape(-1, 3)
    normal = unit / np.array(half)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    parts = [Mesh(unit * np.array(half), normal, _grid(len(polar), len(c)))]
    if top < 1.0:
        rim = parts[0].vertices[-len(c) :]
        vertices = np.vstack([np.tile([cut, 0.0, 0.0], (len(c), 1)), rim])
        parts.append(Mesh(vertices, np.tile([1.0, 0.0, 0.0], (2 * len(c), 1)), _grid(2, len(c))))
    return placed_mesh(_outwards(joined_meshes(parts)), turn, centre)


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
