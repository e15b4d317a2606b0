"""Needs of a plan on a bench: swings, calibrations, disk, work by hand and settings."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise, product
from math import hypot
from pathlib import Path
from typing import Any, NamedTuple

from sqlalchemy import Engine

from bench.base.errors import BenchError, Refused
from bench.calibration.archive import calibration_of, effective_calibration
from bench.calibration.calibration import Calibration, Entry, apply
from bench.campaign.plan.bench_setup import load_lists
from bench.campaign.plan.carry import Measured, require_carry
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import all_trials, is_mounted
from bench.campaign.statistics.block_model import as_split_plot, fully_randomised
from bench.config import Configuration
from bench.supervisor.readiness import assess, mechanically_equal, mount
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.kinematics import head_motion
from sim.robot import Club, RobotParameters

Profiles = Mapping[tuple[str, str], Profile]
"""Keyed by the plan's names of swing and club."""


def require_swings(
    plan: CampaignPlan, configuration: Configuration, when: datetime | None = None
) -> Profiles:
    """Return the plan's profiles, assessed with the bench's calibrations in force at `when`, default now.

    Raises:
        BenchError: a profile or a calibration is missing or cannot be read.
        ExceptionGroup: one BenchError per profile that does not fit a club or cannot be swung here.
    """
    found, faults = dict[tuple[str, str], Profile](), list[Exception]()
    when = when or datetime.now(UTC)
    for arm, path, profile, misfit in _profiles(plan, configuration):
        found[arm] = profile
        if misfit:
            faults.append(misfit)
            continue
        mounted, calibration = _mount(plan, configuration, arm[1], when)
        faults.extend(assess(mounted, calibration, profile, path).faults)
    if faults:
        raise ExceptionGroup("the plan's swings do not fit", faults)
    return found


def swings_of_other_clubs(
    plan: CampaignPlan, configuration: Configuration
) -> dict[tuple[str, str], BenchError]:
    """Return an error for each swing and club of the plan whose profile was designed for a different club.

    Raises:
        BenchError: a profile is missing or cannot be read.
    """
    return {arm: misfit for arm, _, _, misfit in _profiles(plan, configuration) if misfit}


def _profiles(
    plan: CampaignPlan, configuration: Configuration
) -> Iterator[tuple[tuple[str, str], Path, Profile, BenchError | None]]:
    """Yield each swing and club with its profile, and an error if that was designed for another club."""
    for swing, name in product(plan.design.swings, plan.design.clubs):
        path = find_profile(plan.profile(swing, name))
        profile = load_profile(path)
        club, misfit = profile.club, None
        if name != club and not mechanically_equal(plan.clubs[name], configuration.clubs.get(club)):
            misfit = BenchError(
                f"{path}: club",
                f"a swing designed for club {club!r}",
                f"one for {name!r}, or for a club of the same masses and lengths",
                f"Design one: golfbench profile design {name}.toml --club {name}. "
                f'Then name it in the plan: [swings.{swing}] {name} = "{name}.toml".',
            )
        yield (swing, name), path, profile, misfit


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


def arming_problems(plan: CampaignPlan, configuration: Configuration, when: datetime) -> list[BenchError]:
    """Return the reasons against arming a bench at `when` with a swing and club of the plan, each once.

    Raises:
        BenchError: a profile, a calibration or limits cannot be read or applied.
    """
    problems = list[BenchError]()
    for (_, club), path, profile, _ in _profiles(plan, configuration):
        mounted, calibration = _mount(plan, configuration, club, when)
        faults = assess(mounted, calibration, profile, path, running=True).faults
        problems += [*faults, *calibration.problems(when)]
    return list({str(problem): problem for problem in problems}.values())


def machine_refusals(plan: CampaignPlan, measured: Measured, *, monitored: bool) -> Iterator[Refused]:
    """Yield the reasons why hardware, `monitored` by a launch monitor, cannot take the shots of `plan`.

    `measured` are aerodynamics by ball.
    """
    location = f"plan {plan.campaign.name}"
    if plan.analysis.quantity != "club_speed_mps" and not monitored:
        yield Refused(
            f"{location}: analysis.quantity",
            plan.analysis.quantity,
            "club_speed_mps",
            "This bench measures the club only: compare that by analysis.quantity, or for ball data connect "
            "a launch monitor, in the bench's configuration [launch_monitor] enabled = true.",
        )
    try:
        require_carry(plan, measured)
    except Refused as refused:
        yield refused
    if not plan.ball_handling.magazine:
        action = "A real feeder reads no numbers: a person fills it in the listed order and confirms it."
        yield Refused(f"{location}: ball_handling", "magazine 0", "a magazine of at least 1", action)


def _mount(
    plan: CampaignPlan, configuration: Configuration, name: str, when: datetime
) -> tuple[Configuration, Calibration]:
    """Return the configuration with the plan's club `name` mounted, and the calibrations for it."""
    clubs = configuration.clubs | {name: plan.clubs[name]}
    return mount(replace(configuration, clubs=clubs), name, when)


_STEP = 1e-4
"""Step of lengths (m) and angles (rad) for derivatives."""


def calibrations_in_force(
    database: Engine, configuration: Configuration, clubs: Iterable[str], now: datetime
) -> dict[str, Any]:
    """Return the bench's calibrations in force `now` with each of `clubs` mounted, as JSON values."""
    found: dict[int, Entry] = {}
    nominal: set[str] = set()
    for club in clubs:
        calibration = effective_calibration(
            database, configuration.bench.id, now, club=club, tee_of=configuration.tee_of
        )
        found |= {entry.id: entry for entry in calibration.entries}
        nominal |= {f"club {club}" if kind == "club" else kind.value for kind in calibration.nominal}
    return {
        "when": now.isoformat(),
        "in_force": [found[number].record() for number in sorted(found)],
        "nominal": sorted(nominal),
    }


def calibration_versions(
    database: Engine, configuration: Configuration, clubs: Iterable[str], now: datetime
) -> dict[str, str]:
    """Return the versions of the calibrations in force by kind and club, to see what changes between runs."""
    found = calibrations_in_force(database, configuration, clubs, now)
    return {
        " ".join(filter(None, (str(one["kind"]), str(one["subject"])))): f"version {one['version']}"
        for one in found["in_force"]
    }


def calibration_warnings(
    database: Engine,
    configuration: Configuration,
    clubs: Iterable[str],
    now: datetime,
    end: datetime,
    *,
    required: bool,
) -> list[str]:
    """Return the calibrations that keep the bench from arming `now` or before `end`, each with its action.

    `required` includes those that were never made, as on a machine.
    """
    bench, tee_of = configuration.bench.id, configuration.tee_of
    found = [
        effective_calibration(database, bench, now, club=club, required=required, tee_of=tee_of)
        for club in clubs
    ]
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


BYTES = 1_400_000
"""Size of a shot's record in real time, bytes."""
_SCATTER_VENTED = 1.8
"""Largest error of the club speed seen in simulation on a bench that vents after each swing, m/s."""


class Needs(NamedTuple):
    """Needs of a plan without repeats; only the feeder's include warm-ups, the shortest."""

    swings: int
    bytes: int
    club_changes: int
    feeder_fills: int
    hand_work: float
    """Expected time of both, s."""


def needs(plan: CampaignPlan) -> Needs:
    """Return the needs of `plan`."""
    trials, work = all_trials(plan), plan.hand_work
    changes = sum(not is_mounted(plan, one, two) for one, two in pairwise(trials))
    fills = len(load_lists(plan, {}))
    seconds = changes * work.club_change + fills * work.feeder_fill
    return Needs(len(trials), len(trials) * BYTES, changes, fills, seconds)


def free_space(folder: Path) -> int:
    """Return the room on the disk of `folder`, which may not exist yet, bytes."""
    there = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    return shutil.disk_usage(there).free


def needs_words(plan: CampaignPlan, free: int) -> list[str]:
    """Return the needs in words; `free` is the room on the disk, bytes."""
    found = needs(plan)
    room = f"Records: about {found.bytes / 1e9:.2f} GB of {free / 1e9:.1f} GB free."
    if found.bytes > free:
        room += " Not enough: free some space, or name another bench.data_dir."
    if not found.club_changes and not found.feeder_fills:
        return [room, "Work by hand: none is planned."]
    parts = [f"{found.club_changes} club changes", f"{found.feeder_fills} feeder fills"]
    words = [room, f"Work by hand: {', '.join(parts)}, about {found.hand_work / 60:.0f} min in all."]
    return words + _other_layout(plan)


def _other_layout(plan: CampaignPlan) -> list[str]:
    """Return the club changes of the same shots in the other layout; empty without one."""
    if plan.split:
        other = needs(fully_randomised(plan))
        return [f"Fully randomised it would be {_changes(other)}."]
    layout = as_split_plot(plan)
    if layout is None:
        return []
    d = layout.design
    return [
        f"As a split-plot (design.blocks = {d.blocks}, hits_per_mounting = {d.hits_per_mounting}) it would "
        f"be {_changes(needs(layout))}."
    ]


def _changes(found: Needs) -> str:
    return f"{found.club_changes} club changes, about {found.hand_work / 60:.0f} min of work by hand"


def needs_series(plan: CampaignPlan, profiles: Iterable[Profile]) -> bool:
    """Return whether the gate of `plan` is narrower than what venting between swings scatters.

    `profiles` are the plan's. With planned air at their addresses it scatters no more than a series.
    """
    return 0 < plan.gate.club_speed < _SCATTER_VENTED and not all(profile.air for profile in profiles)


def series_words(plan: CampaignPlan) -> str:
    """Return why a bench that vents after each swing does not suit `plan`."""
    return (
        "a bench that vents after each swing, whose next arming leaves other air: that moves the club speed "
        f"by up to {_SCATTER_VENTED:g} m/s in simulation, and the gate accepts ± {plan.gate.club_speed:g} m/s"
    )


START_SERIES = (
    "Start the bench with golfbench run --series, or set [lifecycle] hold_between_swings = true for it, "
    "or plan the air of its profiles: golfbench profile address."
)
"""Action of a bench that vents after each swing."""
