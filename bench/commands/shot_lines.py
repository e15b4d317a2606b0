"""A shot in words: delivery of the club, launch and carry of the ball."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bench.shot.shot_message import ShotPublication

_MPH, _YARD = 0.44704, 0.9144


def shot_lines(message: ShotPublication) -> list[str]:
    """Return the figures of the shot in `message`, a line each for club, ball and what was wrong."""
    shot, number = message["shot"] or {}, message["number"]
    head = "swing" if number is None else f"swing {number}"
    club = _joined(
        _speed(shot, "club_speed_mps", "at the ball"),
        _figure(shot, "attack_angle_deg", "attack {:+.2f}°"),
        _figure(shot, "strike_x_mm", "strike {:+.1f} mm to the toe"),
        _figure(shot, "strike_y_mm", "{:+.1f} mm up"),
    )
    ball = _joined(
        _speed(shot, "ball_speed_mps", ""),
        _figure(shot, "launch_angle_deg", "launch {:.1f}°"),
        _figure(shot, "spin_rpm", "spin {:.0f} rpm"),
        _carry(shot),
    )
    reason = message["reason"] or str(shot.get("reason") or "")
    lines = [f"{head}: {club or 'no delivery'}"]
    if ball:
        lines.append(f"ball: {ball}")
    if reason:
        lines.append(reason)
    return lines


def _joined(*parts: str) -> str:
    return ", ".join(filter(None, parts))


def _figure(shot: Mapping[str, Any], name: str, form: str) -> str:
    value = shot.get(name)
    return "" if value is None else form.format(value)


def _speed(shot: Mapping[str, Any], name: str, where: str) -> str:
    value = shot.get(name)
    return "" if value is None else f"{value:.2f} m/s ({value / _MPH:.1f} mph) {where}".rstrip()


def _carry(shot: Mapping[str, Any]) -> str:
    value, source = shot.get("carry_m"), shot.get("carry_source")
    if value is None:
        return ""
    return f"carry {value:.1f} m ({value / _YARD:.1f} yd)" + (f" by {source}" if source else "")
