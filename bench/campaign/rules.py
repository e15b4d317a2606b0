"""Dated rule sets of the governing bodies: limits, dates, and how certain they are."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from datetime import date
from math import radians
from pathlib import Path

FILE = Path(__file__).with_name("rules.toml")

FOOT = 0.3048


@dataclass(frozen=True)
class RuleSet:
    """One rule with its dates; SI. A set-up figure of 0 is not part of it."""

    name: str
    text: str
    begins: date
    ends: date
    quantity: str
    """Judged column of the shot table."""
    at_most: float
    """Limit, tolerance included; for `symmetry` of a difference."""
    tolerance_included: float
    ball_speed: float
    """m/s"""
    launch_angle: float
    """rad"""
    spin_rpm: float
    confidence: str
    source: str

    def in_force(self, day: date) -> bool:
        """Return whether the rule is in force on `day`."""
        return self.begins <= day <= self.ends


def rule_sets() -> dict[str, RuleSet]:
    """Return the shipped rule sets by name."""
    tables = tomllib.loads(FILE.read_text(encoding="utf-8"))
    return {
        name: RuleSet(
            name=name,
            text=entry["text"],
            begins=entry["from"],
            ends=entry["until"],
            quantity=entry["quantity"],
            at_most=entry["at_most"],
            tolerance_included=entry["tolerance_included"],
            ball_speed=entry["ball_speed"],
            launch_angle=radians(entry["launch_angle_deg"]),
            spin_rpm=entry["spin_rpm"],
            confidence=entry["confidence"],
            source=entry["source"],
        )
        for name, entry in tables.items()
    }


def rule_names() -> list[str]:
    """Return the names of the shipped rule sets."""
    return sorted(rule_sets())


def control_ball_speed(restitution: float, contact_time: float) -> float:
    """Return the ball speed (m/s) that sets the machine, from the control ball's own measurements.

    `restitution` and `contact_time` (s) as measured at 143.8 ft/s in the initial-velocity apparatus.
    USGA/R&A notice of May 2025: V [ft/s] = 180.13 + 123.712 e - 0.04309 t [us], R2 = 0.96.
    """
    return FOOT * (180.13 + 123.712 * restitution - 0.04309 * 1e6 * contact_time)
