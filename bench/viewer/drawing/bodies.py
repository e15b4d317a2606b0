"""Solids and materials that drawn bodies are made of, and their surfaces as triangles for viewers and files.

Volume, centroid and second moments are exact. Three kinds suffice: bars with bores, round tubes, ellipsoids
with a flat cut. Each provides its surface as triangles; `bench.viewer.drawing.model_files` exports the
same solids for a workshop. Lengths in m.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import pi
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.atomic_file import write_whole
from sim.robot import Body, Club
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


_Pair = tuple[float, float]


def _band(start: _Pair, end: _Pair, normal: _Pair, end_normal: _Pair | None = None) -> Mesh:
    """Return the surface of a line turned about x; all pairs are along x and off it (m)."""
    angle = np.linspace(0.0, 2 * pi, SEGMENTS + 1)
    angle[-1] = 0.0  # the last is exactly the first
    c, s = np.cos(angle), np.sin(angle)

    def turned(*ends: _Pair) -> Array:
        return np.vstack([np.column_stack([np.full_like(c, x), off * c, off * s]) for x, off in ends])

    return Mesh(turned(start, end), turned(normal, end_normal or normal), _grid(2, len(c)))


_FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("unused", "<u2")])


def write_stl(path: Path, mesh: Mesh) -> None:
    """Write `mesh` (m) to `path`. Raises NotStored."""
    corners = mesh.vertices[mesh.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets = np.zeros(len(corners), _FACET)
    facets["normal"] = across / np.linalg.norm(across, axis=1)[:, None]
    facets["corners"] = corners
    write_whole(path, b"golfbench, m".ljust(80) + struct.pack("<I", len(facets)) + facets.tobytes())


Turn = tuple[Vector, Vector, Vector] | Array
"""Rows of a rotation matrix."""

NO_TURN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


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
    centre: Vector | Array
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
        faces = []
        for axis in range(3):
            for side in (-1.0, 1.0):
                normal = np.zeros(3)
                normal[axis] = side
                one, other = (np.eye(3)[(axis + k) % 3] for k in (1, 2))
                square = [normal + i * one + j * other for i in (-1, 1) for j in (-1, 1)]
                corners = np.array(square) * np.array(self.size) / 2
                faces.append(Mesh(corners, np.tile(normal, (4, 1)), _grid(2, 2)))
        return placed_mesh(_outwards(joined_meshes(faces)), self.turn, self.centre)


@dataclass(frozen=True)
class Tube:
    """A round tube, or a rod with `inner` 0, between the centres of its ends."""

    start: Vector | Array
    end: Vector | Array
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
        axis = (np.array(self.end) - np.array(self.start)) / self.length
        across = np.cross(np.eye(3)[int(np.argmin(np.abs(axis)))], axis)
        across /= np.linalg.norm(across)
        bands = [
            _band((0.0, self.outer), (self.length, self.outer), (0.0, 1.0)),
            _band((0.0, self.inner), (0.0, self.outer), (-1.0, 0.0)),
            _band((self.length, self.inner), (self.length, self.outer), (1.0, 0.0)),
        ]
        if self.inner > 0:
            bands.append(_band((0.0, self.inner), (self.length, self.inner), (0.0, -1.0)))
        turn = np.column_stack([axis, across, np.cross(axis, across)])
        return placed_mesh(_outwards(joined_meshes(bands)), turn, self.start)


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid of half axes `half`, turned, cut flat at `cut` along its own first axis."""

    half: Vector
    centre: Vector | Array
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
        """Surface; the poles of the unit ball that is scaled lie on the first axis."""
        top = 1.0 if self.cut is None else min(self.cut / self.half[0], 1.0)
        polar = np.linspace(pi, np.arccos(top), SEGMENTS // 2 + 1)
        points = list(zip(np.cos(polar).tolist(), np.sin(polar).tolist(), strict=True))
        points[0] = (-1.0, 0.0)  # exactly
        bands = [_band(one, other, one, other) for one, other in pairwise(points)]
        if top < 1.0:
            bands.append(_band((top, 0.0), points[-1], (1.0, 0.0)))
        unit, half = joined_meshes(bands), np.array(self.half)
        normals = unit.normals / half
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        surface = Mesh(unit.vertices * half, normals, unit.triangles)
        return placed_mesh(_outwards(surface), self.turn, self.centre)


Solid = Bar | Tube | Ellipsoid


Colour = tuple[int, int, int]

_POUND_PER_CUBIC_INCH = 0.45359237 / 0.00001639  # as in the thesis, kg/m3


class Material(NamedTuple):
    """Name, density (kg/m3) and colour (red, green, blue, 0 to 255) of a part."""

    name: str
    density: float
    colour: Colour


STEEL = Material("steel", 0.283 * _POUND_PER_CUBIC_INCH, (112, 122, 136))
ALUMINIUM = Material("aluminium", 0.098 * _POUND_PER_CUBIC_INCH, (196, 203, 211))
CYLINDER = ALUMINIUM._replace(name="cylinder", colour=(38, 112, 178))
CHROME = STEEL._replace(name="chrome", colour=(228, 231, 235))
MOUNT = ALUMINIUM._replace(name="mount", colour=(235, 153, 40))
COMPOSITE = Material("composite", 1600.0, (40, 42, 46))
SHAFT_STEEL = STEEL._replace(name="shaft steel", colour=(150, 154, 160))
ACETAL = Material("acetal", 1410.0, (238, 238, 232))
HEAD = Material("head", 0.0, (172, 32, 40))
FRAME = STEEL._replace(name="frame", colour=(72, 80, 92))
GUARD = Material("hollow profile", 1060.0, (170, 178, 160))
TEE = Material("tee", 700.0, (240, 196, 110))
BALL = Material("ball", 0.0, (255, 255, 255))


@dataclass(frozen=True)
class Part:
    """One solid of one material; a `joint` part is a pin, which the dynamics do not count."""

    name: str
    solid: Solid
    material: Material
    joint: bool = False

    @property
    def mass(self) -> float:
        """Mass (kg); 0 if it is counted elsewhere."""
        return self.material.density * self.solid.volume.volume


@dataclass(frozen=True)
class DrawnBody:
    """A body in its own frame, with the body of the dynamics that it stands for, if any."""

    name: str
    parts: tuple[Part, ...]
    assumed: Body | Club | None = None

    @cached_property
    def weighed(self) -> Volume:
        """Mass (kg), centre of mass (m) and inertia tensor about it (kg m2) of all parts."""
        return joined([(part.material.density, part.solid.volume) for part in self.parts])

    @cached_property
    def without_joints(self) -> Volume:
        """The same without pins and bores: the mass that the dynamics model includes."""
        counted = [(p.material.density, p.solid) for p in self.parts if not p.joint]
        return joined([(density, getattr(solid, "stock", solid.volume)) for density, solid in counted])

    @cached_property
    def mesh(self) -> Mesh:
        """Surface of all parts."""
        return joined_meshes([part.solid.mesh for part in self.parts])

    @cached_property
    def colours(self) -> NDArray[np.uint8]:
        """Colour of each vertex of `mesh`, (n, 3)."""
        rows = [np.tile(part.material.colour, (len(part.solid.mesh.vertices), 1)) for part in self.parts]
        return np.concatenate(rows).astype(np.uint8)


class PlacedBody(NamedTuple):
    """A body with its pose in the golf frame: golf = turn @ own + at."""

    body: DrawnBody
    turn: Array
    at: Array

    @property
    def mesh(self) -> Mesh:
        """Surface in the golf frame."""
        return placed_mesh(self.body.mesh, self.turn, self.at)
