"""Launch monitor record of one ball: SI, each figure known or absent with a reason."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

from drivers.base import Launch

SOURCE = "launch monitor"
"""Source of these figures, beside `encoders+model` and `simulated`."""


class ClubFigures(NamedTuple):
    """Club delivery: m/s, rad, m; None if not measured.

    Angles are positive up or to the right of the target line, the strike towards the toe and up from the
    centre of the face. Definitions differ between manufacturers; the bench's encoders are more accurate.
    """

    speed: float | None = None
    attack_angle: float | None = None
    path: float | None = None
    face_angle: float | None = None
    dynamic_loft: float | None = None
    strike_x: float | None = None
    strike_y: float | None = None


NO_CLUB = ClubFigures()


@dataclass(frozen=True)
class LaunchRecord:
    """One shot of a monitor; the five figures have the signs and units of `drivers.base.Launch`."""

    time: float
    """Time of its last byte, s (CLOCK_MONOTONIC)."""
    device: str
    number: int | None
    """Shot number of the device; it may restart."""
    speed: float | None = None
    launch_angle: float | None = None
    direction: float | None = None
    spin: float | None = None
    spin_axis: float | None = None
    carry: float | None = None
    """Carry estimated by the monitor, m."""
    club: ClubFigures = NO_CLUB
    absent: tuple[tuple[str, str], ...] = ()
    """Missing figures with the reason."""
    doubts: tuple[str, ...] = ()
    """Reasons to distrust the figures: such a record is kept and shown, but not counted."""
    source: str = SOURCE

    @property
    def launch(self) -> Launch | None:
        """The five figures for the flight if all are known, regardless of doubts."""
        figures = (self.speed, self.launch_angle, self.direction, self.spin, self.spin_axis)
        known = [figure for figure in figures if figure is not None]
        return Launch(*known) if len(known) == len(figures) else None

    @property
    def valid(self) -> bool:
        """Whether all five figures are known and undoubted."""
        return self.launch is not None and not self.doubts

    @property
    def reason(self) -> str:
        """Why it is invalid; empty if valid."""
        missing = (f"no {name}: {why}" for name, why in self.absent if name in Launch._fields)
        return "; ".join([*missing, *self.doubts])

    def is_repeat_of(self, other: LaunchRecord) -> bool:
        """Whether `other` is the same record sent again: equal except for its time."""
        return all(
            getattr(self, field.name) == getattr(other, field.name)
            for field in fields(self)
            if field.name != "time"
        )
