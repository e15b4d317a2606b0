"""Solids that the drawn parts are made of, with exact volume, centroid and second moments.

Three kinds suffice: bars with bores, round tubes, ellipsoids with a flat cut. Each knows its surface as
triangles; `bench.drawing.step` makes the same solids for a workshop. Lengths in m.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.drawing.mesh import Mesh, box_mesh, ellipsoid_mesh, tube_mesh
from sim.vectors import Vector

Array = NDArray[np.float64]
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
