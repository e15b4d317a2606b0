"""Design targets of the shipped swings, and the bench that each was designed for."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from bench.config import Configuration, load_configuration
from bench.simulation.simulated_bench import Bench
from bench.swing.library import find_profile
from bench.swing.profile import load_profile


class Demand(NamedTuple):
    """A delivery."""

    speed: float
    """m/s"""
    attack: float = 0.0
    """deg"""
    configuration: str = "shipped"
    """Variant that has club and robot."""
    strike: float = 0.0
    """Ball off the centre of the face, m."""


DEMANDS = {
    "default": Demand(43.2, 2.0),
    "driver-85mph": Demand(38.0, 2.0),
    "driver-90mph": Demand(40.2, 2.0),
    "driver-100mph": Demand(45.0, 2.0),
    "driver-115mph": Demand(51.41, 2.0, "high_speed"),
    "driver-130mph": Demand(58.4, 2.0, "high_speed"),
    "driver-130mph-level": Demand(58.4, 0.0, "high_speed"),
    "average-male": Demand(41.57),
    "senior": Demand(36.66),
    "average-female": Demand(33.53),
    "tour-female": Demand(42.92),
    "two-handicap": Demand(46.94, 2.0),
    "tour-male": Demand(51.03, 2.0),
    "rules-120mph": Demand(53.645, 1.005, "high_speed"),
    "rules-125mph": Demand(56.04, 2.0, "high_speed", 3.79e-3),  # high on the face for little spin
    "face-high": Demand(43.2, 2.0, strike=5.92e-3),
    "face-low": Demand(43.2, 2.0, strike=-7.90e-3),
    "average-male-full": Demand(41.57, 0.0, "golfers"),
    "senior-full": Demand(36.66, 0.0, "golfers"),
    "average-female-full": Demand(33.53, 0.0, "golfers"),
    "tour-female-full": Demand(42.92, 0.0, "golfers"),
    "two-handicap-full": Demand(46.94, 2.0, "golfers"),
    "tour-male-full": Demand(51.41, 2.0, "golfers"),
    "wood3-92mph": Demand(41.1, -0.8, "bag"),
    "hybrid-87mph": Demand(38.9, -1.9, "bag"),
    "iron5-81mph": Demand(36.2, -2.0, "bag"),
    "iron7-78mph": Demand(34.9, -2.5, "bag"),
    "iron8-76mph": Demand(34.0, -2.8, "bag"),
    "iron9-74mph": Demand(33.1, -3.2, "bag"),
    "pitching-72mph": Demand(32.2, -3.2, "bag"),
    "wedge56-55yd": Demand(26.75, -4.5, "bag"),
}
"""By profile; the driver's on its tee, the bag's on turf or on a low tee (averages of the LPGA Tour)."""


def designed_for(name: str) -> Configuration:
    """Return the configuration that the profile `name` was designed for."""
    return load_configuration(Path(DEMANDS[name].configuration)).with_club(
        load_profile(find_profile(name)).club
    )


def mounted(name: str) -> Bench:
    """Return the bench that the profile `name` was designed for, with its club on the club's site."""
    path = find_profile(name)
    profile = load_profile(path)
    c = designed_for(name).for_profile(profile, path)
    return Bench.of(c, profile)
