"""Dated rule sets of the governing bodies: limits, set-ups, dates, and how certain they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from bench.base.from_toml import read_toml

FILE = Path(__file__).with_name("rules.toml")

FOOT = 0.3048
UNITS_OF_RULES: Mapping[str, float] = {"yd": 0.9144, "ft/s": FOOT}


@dataclass(frozen=True)
class RuleSetUp:
    """Set-up of a rule: means of the control ball and the half widths of their windows."""

    ball_speed: float
    ball_speed_window: float
    launch_angle_deg: float
    launch_angle_window_deg: float
    spin_rpm: float
    spin_window_rpm: float
    by_control_ball: bool = False
    """Whether the control ball's restitution and contact time give the ball speed, where they are known."""

    def ball_speed_by(self, restitution: float, contact_time: float) -> float:
        """Return the ball speed (m/s) for a control ball with these figures, 0 where they are not known."""
        if self.by_control_ball and restitution and contact_time:
            return control_ball_speed(restitution, contact_time)
        return self.ball_speed


@dataclass(frozen=True)
class RuleSet:
    """One rule with its dates."""

    name: str
    family: str
    """Name of the sets of which the date chooses one."""
    text: str
    begins: date
    ends: date
    quantity: str
    """Judged column of the shot table."""
    unit: str
    """Unit of the rule's text, a key of `UNITS_OF_RULES`."""
    at_most: float
    """Limit in this unit, tolerance included."""
    confidence: str
    source: str
    difference: bool = False
    """Whether the difference between the levels of a section is judged, not each level."""
    set_up: RuleSetUp | None = None
    apparatus: str = ""
    """Why a robot's figure is never judged; empty where it is."""

    @property
    def scale(self) -> float:
        """The rule's unit in SI."""
        return UNITS_OF_RULES[self.unit]

    def in_force(self, day: date) -> bool:
        """Return whether the rule is in force on `day`."""
        return self.begins <= day <= self.ends


def rule_sets() -> dict[str, RuleSet]:
    """Return the shipped rule sets by name."""
    tables = read_toml(FILE, "the rules", "Reinstall golfbench.")
    for entry in tables.values():
        if "set_up" in entry:
            entry["set_up"] = RuleSetUp(**entry["set_up"])
    return {name: RuleSet(name, **entry) for name, entry in tables.items()}


def rule_names() -> list[str]:
    """Return the names that a plan can give: families and sets."""
    known = rule_sets()
    return sorted({*known, *(rule.family for rule in known.values())})


def rule_on(name: str, day: date) -> RuleSet | None:
    """Return the set called `name`, or of a family the one in force on `day`; None if none is in force."""
    known = rule_sets()
    if name in known:
        return known[name]
    return next((rule for rule in known.values() if rule.family == name and rule.in_force(day)), None)


def control_ball_speed(restitution: float, contact_time: float) -> float:
    """Return the ball speed (m/s) that sets the machine, from the control ball's own measurements.

    `restitution` and `contact_time` (s) as measured at 143.8 ft/s in the initial-velocity apparatus.
    USGA/R&A notice of May 2025: V [ft/s] = 180.13 + 123.712 e - 0.04309 t [us], R2 = 0.96.
    """
    return FOOT * (180.13 + 123.712 * restitution - 0.04309 * 1e6 * contact_time)
