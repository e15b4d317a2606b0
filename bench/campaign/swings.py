"""The swings of a plan: each must be designed for its clubs and possible on this bench."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from itertools import product

from bench.calibration.archive import calibration_of
from bench.calibration.calibration import Calibration, CalibrationProblem, apply
from bench.campaign.plan import CampaignPlan
from bench.config import Configuration
from bench.errors import BenchError
from bench.readiness import assess, felt_alike, mount
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile

Profiles = Mapping[tuple[str, str], Profile]
"""Keyed by the plan's names of swing and club."""


def require_swings(
    plan: CampaignPlan, configuration: Configuration, when: datetime | None = None
) -> Profiles:
    """Return the plan's profiles, assessed with the bench's calibrations in force at `when`, default now.

    Raises:
        BenchError: a profile or a calibration is missing or cannot be read.
        ExceptionGroup: of BenchErrors, if one does not fit a club or cannot be swung here.
    """
    found, faults = dict[tuple[str, str], Profile](), list[Exception]()
    when = when or datetime.now(UTC)
    for swing, name in product(plan.design.swings, plan.design.clubs):
        path = find_profile(plan.profile(swing, name))
        profile = found[swing, name] = load_profile(path)
        club = plan.clubs[name]
        if not felt_alike(club, configuration.clubs.get(profile.club)) and name != profile.club:
            faults.append(
                BenchError(
                    f"{path}: club",
                    f"a swing designed for club {profile.club!r}",
                    f"one for {name!r}, or for a club of the same masses and lengths",
                    f"Design one (golfbench profile design, with club {name}) and name it: "
                    f'[swings.{swing}] {name} = "PROFILE".',
                )
            )
            continue
        mounted, calibration = _mount(plan, configuration, name, when)
        faults.extend(assess(mounted, calibration, profile, path).faults)
    if faults:
        raise ExceptionGroup("the plan's swings do not fit", faults)
    return found


def calibrated(
    plan: CampaignPlan, configuration: Configuration, when: datetime
) -> tuple[CampaignPlan, Configuration]:
    """Return plan and configuration with the calibrations of the bench in force at `when`.

    Raises:
        BenchError: a calibration cannot be read, or belongs to another machine.
    """
    clubs = {}
    for name in plan.design.clubs:
        mounted, calibration = _mount(plan, configuration, name, when)
        clubs[name] = apply(calibration, mounted).clubs[name]
    measured = apply(calibration_of(configuration, when), configuration)
    return replace(plan, clubs=plan.clubs | clubs), measured


def arming_problems(
    plan: CampaignPlan, configuration: Configuration, when: datetime
) -> list[CalibrationProblem]:
    """Return the calibrations that block arming at `when` with one of the plan's clubs, each once."""
    problems = [
        problem
        for name in plan.design.clubs
        for problem in _mount(plan, configuration, name, when)[1].problems(when)
    ]
    return list({problem.text: problem for problem in problems}.values())


def _mount(
    plan: CampaignPlan, configuration: Configuration, name: str, when: datetime
) -> tuple[Configuration, Calibration]:
    """Return the configuration with the plan's club `name` mounted, and the calibrations for it."""
    clubs = configuration.clubs | {name: plan.clubs[name]}
    return mount(replace(configuration, clubs=clubs), name, when)
