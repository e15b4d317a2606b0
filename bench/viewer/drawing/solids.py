"""Solids that the drawn parts are made of, and their surfaces as triangles for viewers, URDF, glTF and STL.

Volume, centroid and second moments are exact. Three kinds suffice: bars with bores, round tubes, ellipsoids
with a flat cut. Each knows its surface as triangles; `bench.viewer.drawing.workshop_files` makes the same
solids for a workshop. Lengths in m.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property
from math import pi
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.records.telemetry.atomic_file import atomic_file
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
    """Return a flat ring at z = `height` that faces +z (`side` 1) or -z (-1)."""
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
    with atomic_file(path) as stream:
        stream.write(b"golfbench, m".ljust(80) + struct.pack("<I", len(facets)) + facets.tobytes())


Turn = tuple[Vector, Vector, Vector]
"""Rows of a rotation matrix."""

NO_TURN: Turn = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Volume(NamedTuple):
    """Volume (m3), centroid (m) and volume's inertia tensor about the centroid (m5)."""

    volume: float
    centroid: Array
    inertia: Array


class Bore(NamedTuple):
    """A bore along a bar's z, at `x`, `y` from the bar's centre (m)."""

    x: float
    y: float
    radius: float


def _tensor(xx: float, yy: float, zz: float) -> Array:
    """Return the inertia tensor of principal second moments xx, yy, zz (the integrals of x2, y2, z2)."""
    return np.diag([yy + zz, xx + zz, xx + yy])


def joined(volumes: list[tuple[float, Volume]]) -> Volume:
    """Return factors times volumes as one; factors may be densities, or -1 for a bore."""
    total = sum(factor * part.volume for factor, part in volumes)
    if not total:
        return Volume(0.0, np.zeros(3), np.zeros((3, 3)))
    centroid = sum((f * p.volume * p.centroid for f, p in volumes), np.zeros(3)) / total
    inertia = np.zeros((3, 3))
    for factor, part in volumes:
        way = part.centroid - centroid
        inertia += factor * (part.inertia + part.volume * (way @ way * np.eye(3) - np.outer(way, way)))
    return Volume(total, centroid, inertia)


@dataclass(frozen=True)
class Bar:
    """A rectangular bar of `size` about `centre`, turned by `turn`, with bores along its own z."""

    size: Vector
    centre: Vector
    turn: Turn = NO_TURN
    bores: tuple[Bore, ...] = ()

    @property
    def stock(self) -> Volume:
        """The bar without its bores."""
        x, y, z = self.size
        volume, turn = x * y * z, np.array(self.turn)
        inertia = volume / 12 * _tensor(x * x, y * y, z * z)
        return Volume(volume, np.array(self.centre), turn @ inertia @ turn.T)

    @cached_property
    def volume(self) -> Volume:
        """The bar with its bores."""
        turn, height = np.array(self.turn), self.size[2]
        parts = [(1.0, self.stock)]
        for bore in self.bores:
            area = pi * bore.radius**2
            across = area * height * bore.radius**2 / 4
            inertia = _tensor(across, across, area * height**3 / 12)
            centre = np.array(self.centre) + turn @ np.array([bore.x, bore.y, 0.0])
            parts.append((-1.0, Volume(area * height, centre, turn @ inertia @ turn.T)))
        return joined(parts)

    @cached_property
    def mesh(self) -> Mesh:
        """Surface without the bores: a pin fills each."""
        return box_mesh(self.size, self.centre, self.turn)


@dataclass(frozen=True)
class Tube:
    """A round tube, or a rod with `inner` 0, between the centres of its ends."""

    start: Vector
    end: Vector
    outer: float
    inner: float = 0.0

    @property
    def length(self) -> float:
        """Length (m)."""
        return float(np.linalg.norm(np.array(self.end) - np.array(self.start)))

    @cached_property
    def volume(self) -> Volume:
        """Volume, centroid and second moments."""
        start, end = np.array(self.start), np.array(self.end)
        length = self.length
        volume = pi * (self.outer**2 - self.inner**2) * length
        across = volume * (self.outer**2 + self.inner**2) / 4
        axis = np.outer(end - start, end - start) / length**2
        second = across * (np.eye(3) - axis) + volume * length**2 / 12 * axis
        return Volume(volume, (start + end) / 2, np.trace(second) * np.eye(3) - second)

    @cached_property
    def mesh(self) -> Mesh:
        """Surface."""
        return tube_mesh(self.start, self.end, self.outer, self.inner)


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid of half axes `half`, turned, cut flat at `cut` along its own first axis."""

    half: Vector
    centre: Vector
    turn: Turn = NO_TURN
    cut: float | None = None

    @cached_property
    def volume(self) -> Volume:
        """Volume, centroid and second moments, of the unit ball's part below the cut."""
        a, b, c = self.half
        h = 1.0 if self.cut is None else min(self.cut / a, 1.0)
        # Integrals over s from -1 to h of pi (1 - s2) times 1, s, s2, and of pi (1 - s2)2 / 4.
        whole = pi * (h - h**3 / 3 + 2 / 3)
        first = pi * (h**2 / 2 - h**4 / 4 - 1 / 4)
        along = pi * (h**3 / 3 - h**5 / 5 + 2 / 15)
        across = pi / 4 * (h - 2 * h**3 / 3 + h**5 / 5 + 8 / 15)
        scale = a * b * c
        shift = a * first / whole
        inertia = _tensor(
            scale * (a * a * along - whole * shift * shift), scale * b * b * across, scale * c * c * across
        )
        turn = np.array(self.turn)
        centroid = np.array(self.centre) + turn @ np.array([shift, 0.0, 0.0])
        return Volume(scale * whole, centroid, turn @ inertia @ turn.T)

    @cached_property
    def mesh(self) -> Mesh:
        """Surface."""
        return ellipsoid_mesh(self.half, self.centre, self.turn, self.cut)


Solid = Bar | Tube | Ellipsoid
