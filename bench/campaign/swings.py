"""The swings of a plan: each must be designed for its clubs and possible on this bench."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from itertools import product

from bench.campaign.plan import CampaignPlan
from bench.config import Configuration
from bench.design.validate import require_possible
from bench.errors import BenchError
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.robot import Club

Profiles = Mapping[tuple[str, str], Profile]
"""Keyed by the plan's names of swing and club."""

_ON_THE_BALL_ONLY = frozenset(
    {
        "name",
        "loft",
        "face_angle",
        "restitution",
        "restitution_slope",
        "tangential_factor",
        "tangential_stiffness",
        "tangential_loss",
        "friction_factor",
        "bulge_radius",
        "roll_radius",
        "tee_shift",
    }
)
"""Fields of a club that do not act on the robot."""


def require_swings(plan: CampaignPlan, configuration: Configuration) -> Profiles:
    """Return the plan's profiles.

    Raises:
        BenchError: a profile is missing or cannot be read.
        ExceptionGroup: of BenchErrors, if one does not fit a club or cannot be swung here.
    """
    found, faults = dict[tuple[str, str], Profile](), list[Exception]()
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
                    f"Design one (golfbench swing design, with club {name}) and name it: "
                    f'[swings.{swing}] {name} = "PROFILE".',
                )
            )
            continue
        designed_for = replace(club, name=profile.club)
        plant = configuration.plant_of(name, designed_for)
        try:
            require_possible(profile, plant, configuration.envelope, str(path))
        except ExceptionGroup as group:
            faults.extend(group.exceptions)
    if faults:
        raise ExceptionGroup("the plan's swings do not fit", faults)
    return found


def with_face_of(club: Club, other: Club) -> Club:
    """Return a club with the mechanics of `club` and the face, head and name of `other`."""
    return replace(club, **{name: getattr(other, name) for name in _ON_THE_BALL_ONLY})


def felt_alike(club: Club, other: Club | None) -> bool:
    """Return whether two clubs are the same to the robot."""
    return other is not None and all(
        getattr(club, f.name) == getattr(other, f.name)
        for f in fields(Club)
        if f.name not in _ON_THE_BALL_ONLY
    )
