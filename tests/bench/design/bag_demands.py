"""Design targets of the shipped swings of the bag and of the driver."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from bench.config import Configuration, load_configuration
from bench.simulation.simulated_bench import SimulatedBench
from bench.swing.library import find_profile
from bench.swing.profile import load_profile


class Demand(NamedTuple):
    """A delivery, and the row of the LPGA Tour's averages that it follows."""

    speed: float
    """m/s"""
    attack: float
    """deg"""
    average: str = ""
    """Club of that row; empty for a partial swing."""
    configuration: str = "bag"
    """Variant that has club and robot."""


DEMANDS = {
    "wood3-92mph": Demand(41.1, -0.8, "3-wood"),
    "hybrid-87mph": Demand(38.9, -1.9, "Hybrid"),
    "iron5-81mph": Demand(36.2, -2.0, "5-iron"),
    "iron7-78mph": Demand(34.9, -2.5, "7-iron"),
    "iron8-76mph": Demand(34.0, -2.8, "8-iron"),
    "iron9-74mph": Demand(33.1, -3.2, "9-iron"),
    "pitching-72mph": Demand(32.2, -3.2, "PW"),
    "wedge56-55yd": Demand(26.75, -4.5),
}
"""By profile, on turf or on a low tee."""
DRIVER_DEMANDS = {
    "driver-85mph": Demand(38.0, 2.0),
    "default": Demand(43.2, 2.0, "Driver"),
    "driver-100mph": Demand(45.0, 2.0),
    "driver-115mph": Demand(51.41, 2.0, configuration="high_speed"),
}
"""By profile, of the driver on its tee."""
ALL_DEMANDS = DRIVER_DEMANDS | DEMANDS


def mounted(name: str) -> SimulatedBench:
    """Return the bench that the profile `name` was designed for, with its club on the club's site."""
    path = find_profile(name)
    profile = load_profile(path)
    c: Configuration = load_configuration(Path(ALL_DEMANDS[name].configuration))
    c = c.with_club(profile.club).for_profile(profile, path)
    return SimulatedBench(profile, c.plant, c.control, c.envelope, c.estimator)
