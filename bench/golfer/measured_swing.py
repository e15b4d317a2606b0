"""A golfer's swing as measured, and what the user states of it.

Definitions: x level towards the target, y up, both in the swing plane; the origin is the head at the ball,
without a club the lead wrist. theta1 is the direction from trail to lead shoulder, theta1 + theta2 that from
lead shoulder to lead wrist, theta1 + theta2 + theta3 that of the shaft, each projected.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bench.golfer.orientation import Orientation
from bench.golfer.roles import Array

STEP = 0.001
"""Time between rows (s)."""
HANDS_CUTOFF = 5 / 3
"""Cut-off of the hands over that of the body."""


@dataclass(frozen=True)
class ImportOptions:
    """What the user states instead of having it found."""

    lead: str = ""
    """Lead side, left or right."""
    up: str = ""
    """Up axis: x, y or z, with a minus for down."""
    top: float | None = None
    """Top (s, time of the file)."""
    impact: float | None = None
    """Impact (s, time of the file)."""
    cutoff: tuple[float, float] = (15.0, 50.0)
    """Cut-off of body and head (Hz); hands are filtered at 5/3 of the body's."""


@dataclass(frozen=True)
class MeasuredSwing:
    """A golfer's swing on a grid of 1 ms that ends at the ball."""

    time: Array
    """Time (n,), 0 at the ball (s)."""
    angle: Array
    """theta1, theta2, theta3 (n, 3), NaN without a club in the last (rad)."""
    position: dict[str, Array]
    """Paths (n, 3) by role in the plane: x to the target, y up, z off the plane (m)."""
    speed: dict[str, Array]
    """Speeds (n,) of hands and head (m/s)."""
    separation: Array | None
    """X-factor (n,): turn of the shoulders less that of the pelvis, None without a pelvis (rad)."""
    top_row: int
    """Row of the top, by the hands."""
    club_top_row: int | None
    """Row in which the shaft turns back."""
    top_clue: str
    """Clue of the top."""
    impact_time: float
    """Impact in the time of the file (s)."""
    impact_clue: str
    """Clue of the impact."""
    plane: float
    """Inclination of the swing plane (rad)."""
    orientation: Orientation
    """Unit, up axis and sides, and how each was found."""
    gaps: dict[str, int]
    """Filled frames by role."""
    not_measured: tuple[str, ...]
    """Quantities for which the file has no marker."""
    rate: float = 0.0
    """Frame rate of the file (Hz)."""
    frames: int = 0
    """Frames of the file."""
    options: ImportOptions = field(default_factory=ImportOptions)
    """Options of the import."""

    @property
    def has_club(self) -> bool:
        """Whether shaft and head were measured."""
        return "head" in self.position

    @property
    def downswing(self) -> slice:
        """Rows from the top to the ball."""
        return slice(self.top_row, len(self.time))

    @property
    def off_plane(self) -> dict[str, float]:
        """Root mean square distance from the plane over the downswing by role (m)."""
        return {
            role: float(np.sqrt(np.mean(path[self.downswing, 2] ** 2)))
            for role, path in self.position.items()
            if role in ("lead_shoulder", "lead_wrist", "head")
        }

    @property
    def hub_travel(self) -> tuple[float, float]:
        """Range of the mean of both shoulders over the downswing along x and y (m)."""
        hub = (self.position["lead_shoulder"] + self.position["trail_shoulder"])[self.downswing] / 2
        x, y, _ = np.ptp(hub, axis=0)
        return float(x), float(y)
