"""The swings of a plan: each must be designed for the clubs it swings, and possible on this bench."""

from __future__ import annotations

from dataclasses import fields, replace

from bench.campaign.plan import Plan
from bench.config import Configuration
from bench.errors import BenchError
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from bench.swing.validate import require_possible
from sim.robot import Club

_ON_THE_BALL_ONLY = frozenset(
    {"name", "loft", "face_angle", "restitution", "tangential_factor", "bulge_radius", "roll_radius"}
)
"""Fields of a club that the robot does not feel."""


def require_swings(plan: Plan, configuration: Configuration) -> dict[str, Profile]:
    """Return the plan's profiles by the names it gives them.

    Raises:
        BenchError: a profile is missing or cannot be read.
        ExceptionGroup: of BenchErrors, where one does not fit a club or cannot be swung here.
    """
    profiles, faults = {}, list[Exception]()
    for swing in plan.design.swings:
        path = find_profile(swing)
        profile = profiles[swing] = load_profile(path)
        for name in plan.design.clubs:
            club = plan.clubs[name]
            if not _alike(club, configuration.clubs.get(profile.club)) and name != profile.club:
                faults.append(
                    BenchError(
                        f"{path}: club",
                        f"a swing designed for club {profile.club!r}",
                        f"one for {name!r}, or for a club of the same masses and lengths",
                        f"Design one: golfbench swing design, with club {name}.",
                    )
                )
                continue
            designed_for = replace(club, name=profile.club)
            plant = replace(configuration.plant, robot=replace(configuration.plant.robot, club=designed_for))
            try:
                require_possible(profile, plant, configuration.envelope, str(path))
            except ExceptionGroup as group:
                faults.extend(group.exceptions)
    if faults:
        raise ExceptionGroup("the plan's swings do not fit", faults)
    return profiles


def _alike(club: Club, other: Club | None) -> bool:
    """Tell whether the robot feels no difference between two clubs."""
    return other is not None and all(
        getattr(club, f.name) == getattr(other, f.name)
        for f in fields(Club)
        if f.name not in _ON_THE_BALL_ONLY
    )
