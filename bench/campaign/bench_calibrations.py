"""Calibrations of the bench in force when a campaign begins, and what club speed owes them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import datetime
from math import hypot
from typing import Any

from sqlalchemy import Engine

from bench.calibration.archive import effective_calibration
from bench.calibration.calibration import Entry
from bench.campaign.swings import Profiles
from bench.swing.profile import Profile
from sim.kinematics import head_motion
from sim.robot import Club, RobotParameters

_STEP = 1e-4
"""Step of lengths (m) and angles (rad) for derivatives."""


def calibrations_in_force(
    database: Engine, bench: str, clubs: Iterable[str], now: datetime
) -> dict[str, Any]:
    """Return the calibrations of `bench` in force `now` with each of `clubs` mounted, as JSON values."""
    found: dict[int, Entry] = {}
    nominal: set[str] = set()
    for club in clubs:
        calibration = effective_calibration(database, bench, now, club=club)
        found |= {entry.id: entry for entry in calibration.entries}
        nominal |= {f"club {club}" if kind == "club" else kind.value for kind in calibration.nominal}
    return {
        "when": now.isoformat(),
        "in_force": [found[number].record() for number in sorted(found)],
        "nominal": sorted(nominal),
    }


def calibration_versions(database: Engine, bench: str, clubs: Iterable[str], now: datetime) -> dict[str, str]:
    """Return the versions of the calibrations in force by kind and club, to see what changes between runs."""
    found = calibrations_in_force(database, bench, clubs, now)
    return {
        " ".join(filter(None, (str(one["kind"]), str(one["subject"])))): f"version {one['version']}"
        for one in found["in_force"]
    }


def calibration_warnings(
    database: Engine, bench: str, clubs: Iterable[str], now: datetime, end: datetime, *, required: bool
) -> list[str]:
    """Return the calibrations that keep the bench from arming `now` or before `end`, each with its action.

    `required` includes those that were never made, as on a machine.
    """
    found = [effective_calibration(database, bench, now, club=club, required=required) for club in clubs]
    today = dict.fromkeys(problem.text for one in found for problem in one.problems(now))
    ending = dict.fromkeys(problem.text for one in found for problem in one.problems(end, now))
    restart = ", then start the bench again: it does not arm before."
    return [
        *(f"{text[0].upper()}{text[1:]}{restart}" for text in today),
        *(
            f"{text[0].upper()}{text[1:]}, before the expected end of the campaign, {end:%Y-%m-%d %H:%M} UTC."
            for text in ending
            if text not in today
        ),
    ]


def speed_sensitivities(
    profiles: Profiles, clubs: Mapping[str, Club], robot: RobotParameters
) -> list[dict[str, Any]]:
    """Return by swing and club how club speed at the ball depends on club length and encoder zeros."""
    return [
        {"swing": swing, "club": club, **speed_sensitivity(profile, replace(robot, club=clubs[club]))}
        for (swing, club), profile in profiles.items()
    ]


def speed_sensitivity(profile: Profile, robot: RobotParameters) -> dict[str, float]:
    """Return derivatives of the planned club speed at contact.

    "length": by the club's length to its face, (m/s)/m; "zeros": root of the sum of squares of those by the
    three encoders' zeros, (m/s)/rad: their errors are independent and equally uncertain.
    """
    at = min(round(profile.impact_time / profile.period), len(profile.angle) - 1)
    angles, rates = profile.angle[at], profile.velocity[at]

    def speed(length: float, *zeros: float) -> float:
        club = replace(robot.club, length_to_face=robot.club.length_to_face + length)
        record = replace(robot, club=club).record[0]
        motion = head_motion(record, *(angles + zeros), *rates)
        return hypot(motion[3], motion[4])

    def slope(place: int) -> float:
        step = [_STEP if place == index else 0.0 for index in range(4)]
        return (speed(*step) - speed(*(-one for one in step))) / (2 * _STEP)

    return {"length": slope(0), "zeros": hypot(slope(1), slope(2), slope(3))}
