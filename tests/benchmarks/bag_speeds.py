"""The PGA Tour's speed and attack of each club: a swing designed for them, or the fastest and what binds.

Each is designed for the plant that the club's site gives, near the shipped swing, with the lean of the bag's
own swing; where that fails, not near it. A designed one is swung, and the bench falls silent around the ball.
Where both fail, the fastest downswing of the same attack and lean is searched, with what one per cent more of
each limit would give. Minutes a club: `--clubs` takes some, `--save FOLDER` keeps the profiles, `--quick`
searches nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from math import degrees, radians
from pathlib import Path
from typing import NamedTuple

from bench.config import Configuration, load_configuration
from bench.design.check import TRIALS, SwingCheck
from bench.design.designer import DesignFailed, SwingDemand, design_swing
from bench.design.follow import demand_near
from bench.design.highest_speed import DownswingStudy, HighestSpeed, highest_speed
from bench.simulation.local_engine import InProcess
from bench.simulation.simulated_bench import SimulatedBench, simulate_swing
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile, save_profile
from tests.benchmarks.row import Row
from tests.benchmarks.whole_table import print_whole
from tests.sim.tour_averages import tour_averages

NAME = "bag_speeds"
AROUND_THE_BALL = range(-80, 121, 20)
"""Ticks from the ball at which the bench falls silent."""


class Wanted(NamedTuple):
    """A row of the averages, and how it is swung."""

    configuration: str
    club: str
    row: str
    lean: float | None = None
    """deg; None: the easiest."""
    near: str = "default"
    """Swing that the design starts from and stays near."""
    attack: float | None = None
    """deg; None: the row's."""


WANTED = {
    "driver": Wanted("", "driver", "Driver"),
    "driver rising by 2 deg": Wanted("", "driver", "Driver", near="driver-100mph", attack=2.0),
    "driver, high_speed": Wanted("high_speed", "driver", "Driver", near="driver-130mph-level"),
    "wood3": Wanted("bag", "wood3", "3-wood", lean=-1.2),
    "hybrid": Wanted("bag", "hybrid", "Hybrid", lean=-2.7),
    "iron5": Wanted("bag", "iron5", "5-iron"),
    "iron7": Wanted("bag", "iron7", "7-iron", lean=-9.5),
    "iron8": Wanted("bag", "iron8", "8-iron", lean=-9.5),
    "iron9": Wanted("bag", "iron9", "9-iron", lean=-9.5),
    "pitching": Wanted("bag", "pitching", "PW"),
}


class Tried(NamedTuple):
    """What became of a demand."""

    name: str
    demand: SwingDemand
    designed: SimulatedBench | None
    """The bench with the designed swing; None if there is none."""
    reason: str
    """Why there is none."""
    highest: HighestSpeed | None


def tried(name: str, *, search: bool) -> Tried:
    """Return what becomes of the demand called `name`; with `search` the fastest downswing if it fails."""
    wanted = WANTED[name]
    c = load_configuration(Path(wanted.configuration) if wanted.configuration else None)
    c = c.with_club(wanted.club)
    c = replace(c, envelope=c.envelope.with_model_check("off"))  # a new swing has no limits
    start = load_profile(find_profile(wanted.near))
    (average,) = (a for a in tour_averages() if (a.group, a.club) == ("PGA", wanted.row))
    demand = SwingDemand(
        head_speed=average.speed,
        attack=average.attack if wanted.attack is None else radians(wanted.attack),
        lean=None if wanted.lean is None else radians(wanted.lean),
    )
    reasons = list[str]()
    for how in (demand_near(c.plant, start, demand), demand):
        try:
            profile = _designed(c, how, name, start)
        except DesignFailed as failure:
            reasons.append(str(failure))
            continue
        bench = SimulatedBench(profile, c.plant, c.control, c.envelope, c.estimator)
        return Tried(name, demand, bench, "", None)
    reason, found = "; ".join(dict.fromkeys(reasons)), None
    if search:
        study = DownswingStudy(c.plant, demand, c.control, c.envelope, c.estimator, start)
        try:
            found = highest_speed(study, InProcess())
        except DesignFailed as failure:
            reason = f"{reason}; the fastest: {failure}"
    return Tried(name, demand, None, reason, found)


def _designed(c: Configuration, demand: SwingDemand, name: str, start: Profile) -> Profile:
    return design_swing(
        c.plant,
        demand,
        name,
        control=c.control,
        envelope=c.envelope,
        estimator=c.estimator,
        start=start,
    ).profile


def _silent(bench: SimulatedBench) -> tuple[int, int]:
    """Return the instants around the ball at which a silent bench ends unsafe, and all that were tried."""
    check = SwingCheck(bench.plant, bench.profile, bench.control, bench.envelope, bench.estimator)
    trials = tuple(trial for trial in TRIALS if trial.name.startswith("bench silent"))
    contact = round(bench.profile.impact_time / bench.profile.period)
    outcomes = check.outcomes(trials, ticks=[contact + ticks for ticks in AROUND_THE_BALL])
    return sum(bool(outcome.unsafe) for outcome in outcomes), len(outcomes)


_COLUMNS = (
    "club",
    "demanded m/s",
    "attack",
    "m/s",
    "attack",
    "lean",
    "strike, mm",
    "cushion missed, silent",
    "silent: unsafe",
)


def _shown(one: Tried) -> tuple[str, ...]:
    demand = one.demand
    asked = f"{demand.head_speed or 0.0:.2f}", f"{degrees(demand.attack):+.1f}"
    if one.designed is None:
        fastest = "" if one.highest is None else f"plan at most {one.highest.plan.speed:.1f}"
        return one.name, *asked, fastest or "none"
    delivery, limits = simulate_swing(one.designed).delivery, one.designed.profile.limits
    if delivery is None:
        return one.name, *asked, "missed its ball"
    unsafe, cases = _silent(one.designed)
    return (
        one.name,
        *asked,
        f"{delivery.speed:.2f}",
        f"{degrees(delivery.attack_angle):+.2f}",
        f"{degrees(delivery.shaft_lean):+.2f}",
        f"{1e3 * delivery.in_plane_error:+.2f}",
        f"{100 * limits['stop_share_missed']:.0f} %, {100 * limits['stop_share_silent']:.0f} %",
        f"{unsafe} of {cases}",
    )


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Design all, print what was delivered and what binds, and return how many could be designed."""
    parser = argparse.ArgumentParser(prog=f"python -m tests.benchmarks {NAME}", description=__doc__)
    parser.add_argument("--clubs", nargs="+", choices=WANTED, default=list(WANTED), metavar="NAME")
    parser.add_argument("--save", type=Path, metavar="FOLDER", help="keep the designed profiles there")
    parser.add_argument("--quick", action="store_true", help="search no fastest downswing")
    given = parser.parse_args(arguments)
    found = list[Tried]()
    for name in given.clubs:
        one = tried(name, search=not given.quick)
        found.append(one)
        print(f"{name}: {one.reason or 'designed'}", flush=True)
        if one.highest is not None:
            print(f"  plan at most {one.highest.plan.speed:.1f} m/s, {one.highest.limit}", flush=True)
            for limit, gain in list(one.highest.plan.binding.items())[:5]:
                print(f"  one per cent more of {limit}: {gain:+.3f} m/s", flush=True)
        if given.save is not None and one.designed is not None:
            given.save.mkdir(parents=True, exist_ok=True)
            file = f"{name.replace(', ', '-').replace(' ', '-')}.toml"
            save_profile(given.save / file, one.designed.profile)
    print_whole("the PGA Tour's speeds: demanded, delivered", _COLUMNS, map(_shown, found))
    designed = sum(one.designed is not None for one in found)
    return [Row(NAME, "swings designed", designed, "", f"of {len(found)}")]
