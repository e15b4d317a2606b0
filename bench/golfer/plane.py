"""The swing plane, angles and directions in it. Pure functions, SI units."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class SwingPlane(NamedTuple):
    """A plane through the ball: axes as unit vectors in the file's directions."""

    target: Array
    """Level, towards the target (3,)."""
    up: Array
    """Up in the plane (3,)."""
    normal: Array
    """Normal of the plane, upwards (3,)."""

    @property
    def axes(self) -> Array:
        """The three unit vectors as rows (3, 3)."""
        return np.stack([self.target, self.up, self.normal])

    def inclination(self, vertical: Array) -> float:
        """Return the angle between the plane and the ground (rad)."""
        return float(np.arccos(np.clip(abs(self.normal @ vertical), 0.0, 1.0)))


def fitted_plane(arc: Array, vertical: Array) -> SwingPlane:
    """Return the plane of least squares through `arc` (n, 3), which moves towards the target at its end."""
    _, _, axes = np.linalg.svd(arc - arc.mean(axis=0), full_matrices=False)
    normal = axes[2] * (1.0 if axes[2] @ vertical >= 0.0 else -1.0)
    up = vertical - (vertical @ normal) * normal
    up /= np.linalg.norm(up)
    target = np.cross(up, normal)
    moving = arc[-1] - arc[-min(len(arc), 6)]
    return SwingPlane(target * (1.0 if target @ moving >= 0.0 else -1.0), up, normal)


def last_level_row(from_: Array, to: Array, vertical: Array) -> int:
    """Return the last row in which the line between two paths (n, 3) turns below level; 0 if never."""
    above = (to - from_) @ vertical > 0.0
    rows = np.flatnonzero(above)
    return int(rows[-1]) if len(rows) else 0


def projected_angle(vectors: Array, plane: SwingPlane) -> Array:
    """Return the angles (n,) of `vectors` (n, 3) in the plane from the level towards the target (rad)."""
    found: Array = np.unwrap(np.arctan2(vectors @ plane.up, vectors @ plane.target))
    return found


def turn_about(vectors: Array, target: Array, front: Array) -> Array:
    """Return how far level lines (n, 3) are turned away from the target (rad), the lead side to `front`."""
    found: Array = np.unwrap(np.arctan2(vectors @ front, vectors @ target))
    return found
