"""Plausibility of launch figures. Doubtful records are marked, not dropped."""

from __future__ import annotations

from dataclasses import replace
from math import degrees, radians

from drivers.launch_monitor.record import LaunchRecord

SPEED = (5.0, 100.0)
"""Range of plausible ball speeds, m/s."""
MAX_LAUNCH_ANGLE = radians(60.0)
"""Maximum launch angle, rad; the minimum is just above 0, the value of misreads."""
MAX_DIRECTION = radians(30.0)
"""Maximum direction to either side, rad."""
MAX_SPIN = 1570.0
"""Maximum spin, rad/s (15,000 rpm)."""
SMASH = (0.8, 1.6)
"""Range of smash factors (ball speed over club speed): an elastic 46 g ball off a 200 g head reaches 1.63,
one at the Rules' limit 1.5."""


def add_doubts(record: LaunchRecord, club_speed: float | None = None) -> LaunchRecord:
    """Return `record` with its doubts; `club_speed` (m/s) replaces the monitor's own."""
    doubts = [*record.doubts]
    speed, angle, direction, spin = record.speed, record.launch_angle, record.direction, record.spin
    if speed is not None and not SPEED[0] <= speed <= SPEED[1]:
        doubts.append(f"ball speed {speed:.3g} m/s, expected {SPEED[0]:g} to {SPEED[1]:g}")
    if angle is not None and not 0.0 < angle <= MAX_LAUNCH_ANGLE:
        most = f"{degrees(MAX_LAUNCH_ANGLE):.3g}"
        doubts.append(f"launch angle {degrees(angle):.3g} deg, expected above 0 to {most}")
    if direction is not None and abs(direction) > MAX_DIRECTION:
        most = f"{degrees(MAX_DIRECTION):.3g} at most to either side"
        doubts.append(f"direction {degrees(direction):.3g} deg, expected {most}")
    if spin is not None and spin > MAX_SPIN:
        doubts.append(f"spin {spin:.4g} rad/s, expected {MAX_SPIN:g} at most")
    club = record.club.speed if club_speed is None else club_speed
    if speed is not None and club is not None and club > 0.0:
        smash = speed / club
        if not SMASH[0] <= smash <= SMASH[1]:
            doubts.append(f"ball speed {smash:.3g} times the club's, expected {SMASH[0]:g} to {SMASH[1]:g}")
    once = tuple(dict.fromkeys(doubts))
    return record if once == record.doubts else replace(record, doubts=once)
