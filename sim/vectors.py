"""Three-vectors as tuples: no allocation in compiled code, plain values elsewhere."""

from __future__ import annotations

from math import cos, sin, sqrt

from drivers.base.compiled import compiled

Vector = tuple[float, float, float]


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@compiled
def norm(a: Vector) -> float:
    """Return the length of a."""
    return sqrt(dot(a, a))


@compiled
def scaled(k: float, a: Vector) -> Vector:
    """Return k a."""
    return (k * a[0], k * a[1], k * a[2])


@compiled
def added(a: Vector, k: float, b: Vector) -> Vector:
    """Return a + k b."""
    return (a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2])


@compiled
def unit(a: Vector) -> Vector:
    """Return a / |a|; the zero vector stays zero."""
    length = norm(a)
    return scaled(1.0 / length, a) if length > 0.0 else a


@compiled
def across_flight(elevation: float, azimuth: float) -> tuple[Vector, Vector]:
    """Return the unit vectors (right, up) across a flight at these angles (rad), in the golf frame."""
    right = (-sin(azimuth), 0.0, cos(azimuth))
    return right, (-sin(elevation) * cos(azimuth), cos(elevation), -sin(elevation) * sin(azimuth))
