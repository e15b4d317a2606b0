"""Whether figures can be those of a struck ball. Doubtful ones are kept apart, not thrown away."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import degrees, pi
from typing import Annotated

from annotated_types import Ge, Gt, Le

from drivers.launch_monitor.record import LaunchRecord


@dataclass(frozen=True)
class PlausibleFigures:
    """Bounds between which a launch of this bench can lie."""

    min_speed: Annotated[float, Ge(0.0), Le(120.0)] = 5.0
    """m/s of the ball."""
    max_speed: Annotated[float, Gt(0.0), Le(120.0)] = 100.0
    """m/s of the ball."""
    max_launch_angle: Annotated[float, Gt(0.0), Le(pi / 2)] = 1.0472
    """rad (60 deg); the least is just above 0, which is what misreads say."""
    max_direction: Annotated[float, Gt(0.0), Le(pi / 2)] = 0.5236
    """rad (30 deg) to either side."""
    max_spin: Annotated[float, Gt(0.0), Le(2500.0)] = 1570.0
    """rad/s; 15,000 rpm."""
    min_smash: Annotated[float, Ge(0.0), Le(1.6)] = 0.8
    """Ball speed over club speed."""
    max_smash: Annotated[float, Gt(0.0), Le(2.0)] = 1.6
    """An elastic ball of 46 g off a club of 200 g leaves with 1.63 times its speed, one at the Rules' limit
    with 1.5."""

    def __post_init__(self) -> None:
        """Raise ValueError when a min is not below its max."""
        for name in ("speed", "smash"):
            if getattr(self, f"min_{name}") >= getattr(self, f"max_{name}"):
                raise ValueError(f"min_{name}: less than max_{name}")


def judged(record: LaunchRecord, bounds: PlausibleFigures, club_speed: float | None = None) -> LaunchRecord:
    """Return `record` with its doubts; `club_speed` (m/s) is the bench's own, else the monitor's serves."""
    doubts = [*record.doubts]
    speed, angle, direction, spin = record.speed, record.launch_angle, record.direction, record.spin
    if speed is not None and not bounds.min_speed <= speed <= bounds.max_speed:
        doubts.append(f"ball speed {speed:.3g} m/s, expected {bounds.min_speed:g} to {bounds.max_speed:g}")
    if angle is not None and not 0.0 < angle <= bounds.max_launch_angle:
        doubts.append(
            f"launch angle {degrees(angle):.3g} deg, expected above 0 to "
            f"{degrees(bounds.max_launch_angle):.3g}"
        )
    if direction is not None and abs(direction) > bounds.max_direction:
        doubts.append(
            f"direction {degrees(direction):.3g} deg, expected {degrees(bounds.max_direction):.3g} "
            "at most to either side"
        )
    if spin is not None and spin > bounds.max_spin:
        doubts.append(f"spin {spin:.4g} rad/s, expected {bounds.max_spin:g} at most")
    club = record.club.speed if club_speed is None else club_speed
    if speed is not None and club is not None and club > 0.0:
        smash = speed / club
        if not bounds.min_smash <= smash <= bounds.max_smash:
            doubts.append(
                f"ball speed {smash:.3g} times the club's, expected {bounds.min_smash:g} to "
                f"{bounds.max_smash:g}"
            )
    once = tuple(dict.fromkeys(doubts))
    return record if once == record.doubts else replace(record, doubts=once)
