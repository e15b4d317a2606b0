"""Launch monitor record of one ball: SI, each figure known or absent with a reason."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from drivers.base import Launch

SOURCE = "launch monitor"
"""Source of these values; the others are `encoders+model` and `simulated`."""


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


class ClubRecord(NamedTuple):
    """Club figures of a message without a ball: never a launch, but part of one."""

    time: float
    """Time of its last byte, s (CLOCK_MONOTONIC)."""
    device: str
    club: ClubFigures
    absent: tuple[tuple[str, str], ...] = ()
    """Missing figures with the reason."""


class RefusedRecord(NamedTuple):
    """A message that was refused."""

    time: float
    """Time of its last byte, s (CLOCK_MONOTONIC)."""
    reason: str


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

    def with_club(self, club: ClubFigures, absent: tuple[tuple[str, str], ...]) -> LaunchRecord:
        """Return the record with the figures of `club` that it lacks; `absent` are those of `club`."""
        known = ClubFigures(*(b if a is None else a for a, b in zip(self.club, club, strict=True)))
        if known == self.club:
            return self
        lacking = {f"club.{name}" for name, value in known._asdict().items() if value is None}
        of_ball = (each for each in self.absent if not each[0].startswith("club."))
        of_club = (each for each in (*self.absent, *absent) if each[0] in lacking)
        return replace(self, club=known, absent=tuple(dict.fromkeys((*of_ball, *of_club))))

    def is_repeat_of(self, other: LaunchRecord) -> bool:
        """Whether it is the ball of `other`: sent again, or sent with and without its club."""
        same = all(
            getattr(self, name) == getattr(other, name) for name in ("device", "carry", *Launch._fields)
        )
        completed = (self.club == NO_CLUB) != (other.club == NO_CLUB)
        return same and (self.number == other.number or completed)
