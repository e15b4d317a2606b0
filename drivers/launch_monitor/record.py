"""What a launch monitor told of one ball: SI, each figure known or absent with the reason."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

from drivers.base import Launch

SOURCE = "launch monitor"
"""How these figures were come by, beside `encoders+model` and `simulated`."""


class ClubFigures(NamedTuple):
    """The club at the ball: m/s, rad, m; None where it was not measured.

    Angles are positive up or to the right of the target line, the strike towards the toe and up from the
    centre of the face. Makers differ in what they send here; the bench's own encoders know better.
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
    """One shot as a monitor told it; the five figures have the signs and units of `drivers.base.Launch`."""

    time: float
    """s, CLOCK_MONOTONIC, when its last byte was taken."""
    device: str
    number: int | None
    """The device's own count; it may begin again."""
    speed: float | None = None
    launch_angle: float | None = None
    direction: float | None = None
    spin: float | None = None
    spin_axis: float | None = None
    carry: float | None = None
    """m, the monitor's own estimate."""
    club: ClubFigures = NO_CLUB
    absent: tuple[tuple[str, str], ...] = ()
    """Figures that are None, and why."""
    doubts: tuple[str, ...] = ()
    """Why the figures are not to be trusted: such a record is kept, shown and not counted."""
    source: str = SOURCE

    @property
    def launch(self) -> Launch | None:
        """The five figures when all are known, for the flight; doubts do not matter here."""
        figures = (self.speed, self.launch_angle, self.direction, self.spin, self.spin_axis)
        known = [figure for figure in figures if figure is not None]
        return Launch(*known) if len(known) == len(figures) else None

    @property
    def valid(self) -> bool:
        """All five figures are known and nothing speaks against them."""
        return self.launch is not None and not self.doubts

    @property
    def reason(self) -> str:
        """Why it is not valid; empty when it is."""
        missing = (f"no {name}: {why}" for name, why in self.absent if name in Launch._fields)
        return "; ".join([*missing, *self.doubts])

    def tells_the_same(self, other: LaunchRecord) -> bool:
        """Whether `other` is this one sent again: everything equal but its time."""
        return all(
            getattr(self, field.name) == getattr(other, field.name)
            for field in fields(self)
            if field.name != "time"
        )
