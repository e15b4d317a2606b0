"""Plausibility of launch figures. Doubtful records are marked, not dropped."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import degrees, pi
from typing import Annotated

from drivers.base.ranges import Above, AtLeast, AtMost
from drivers.launch_monitor.record import LaunchRecord


@dataclass(frozen=True)
class PlausibleFigures:
    """Bounds of plausible launches of this bench."""

    min_speed: Annotated[float, AtLeast(0.0), AtMost(120.0)] = 5.0
    """Minimum ball speed, m/s."""
    max_speed: Annotated[float, Above(0.0), AtMost(120.0)] = 100.0
    """Maximum ball speed, m/s."""
    max_launch_angle: Annotated[float, Above(0.0), AtMost(pi / 2)] = 1.0472
    """Maximum launch angle, rad (60 deg); the minimum is just above 0, the value of misreads."""
    max_direction: Annotated[float, Above(0.0), AtMost(pi / 2)] = 0.5236
    """Maximum direction to either side, rad (30 deg)."""
    max_spin: Annotated[float, Above(0.0), AtMost(2500.0)] = 1570.0
    """Maximum spin, rad/s (15,000 rpm)."""
    min_smash: Annotated[float, AtLeast(0.0), AtMost(1.6)] = 0.8
    """Minimum smash factor (ball speed over club speed)."""
    max_smash: Annotated[float, Above(0.0), AtMost(2.0)] = 1.6
    """Maximum smash factor: an elastic 46 g ball off a 200 g head reaches 1.63, one at the Rules' limit
    1.5."""

    def __post_init__(self) -> None:
        """Raise ValueError if a minimum is not below its maximum."""
        for name in ("speed", "smash"):
            if getattr(self, f"min_{name}") >= getattr(self, f"max_{name}"):
                raise ValueError(f"min_{name}: less than max_{name}")


def add_doubts(
    record: LaunchRecord, bounds: PlausibleFigures, club_speed: float | None = None
) -> LaunchRecord:
    """Return `record` with its doubts; `club_speed` (m/s) replaces the monitor's own."""
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
