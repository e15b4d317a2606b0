"""No false alarms: swings of plants that differ within their tolerances, the controller as it was designed.

    python -m tests.benchmarks healthy_swings [--swings 1000] [--spread 1.0]

Each swing is of another plant, drawn from its seed, from the hanging pose over arming, address and swing to
the return; every fourth has no ball. `--spread` widens or narrows all tolerances.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.progress import track

from bench.config import load_configuration, shipped_configuration
from bench.control.settings import build_controller
from bench.control.step import SWING, ControlParameters
from bench.lifecycle import Cause, Phase
from bench.lockstep import Lockstep
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.driver import hanging_pose
from sim.plant import PlantParameters, build_plant
from sim.pneumatics import Actuator
from tests.benchmarks.row import Row

TOLERANCE = {
    "conductance": 0.025, "spool frequency": 0.05, "dead band": 0.15, "friction": 0.15, "dead volume": 0.05,
    "supply pressure": 0.01, "inertia": 0.01,
}  # fmt: skip
"""Shares of the nominal value; assumption: what calibration and a good maker leave."""
CENTRE = 0.0015
"""Of a valve, in openings."""
LEAKAGE = 2.0
"""Leakages are up to so many times their nominal value above and 1 below it."""
NOISE, JITTER = 1e-5, 2e-6
"""Of the encoders at most, rad and s."""
_CHUNK, _LONGEST_RETURN = 500, 12_000


def drawn_plant(plant: PlantParameters, seed: int, spread: float = 1.0) -> PlantParameters:
    """Return `plant` as `seed` has it within `spread` times its tolerances; seed 0 is the nominal one."""
    random = np.random.default_rng(seed)
    spread = spread if seed else 0.0

    def about_1(name: str) -> float:
        return float(1.0 + spread * TOLERANCE[name] * random.uniform(-1.0, 1.0))

    def leaking() -> float:
        return float(1.0 + spread * random.uniform(-0.5, LEAKAGE)) if spread else 1.0

    def actuator(a: Actuator) -> Actuator:
        coulomb = a.friction.coulomb * about_1("friction")
        static = max(a.friction.static * about_1("friction"), 1.05 * coulomb)
        friction = replace(
            a.friction, viscous=a.friction.viscous * about_1("friction"), coulomb=coulomb, static=static
        )
        valve = replace(
            a.valve, conductance=a.valve.conductance * about_1("conductance"),
            natural_frequency=a.valve.natural_frequency * about_1("spool frequency"),
            dead_band=a.valve.dead_band * about_1("dead band"), leakage=a.valve.leakage * leaking(),
            centre=spread * CENTRE * float(random.uniform(-1.0, 1.0)),
        )  # fmt: skip
        return replace(
            a, dead_volume=a.dead_volume * about_1("dead volume"),
            cross_leakage=a.cross_leakage * leaking(), friction=friction, valve=valve,
        )  # fmt: skip

    robot, supply = plant.robot, plant.supply
    left, link, club = robot.left_arm, robot.shoulder_link, robot.club
    return replace(
        plant, shoulder=actuator(plant.shoulder), right_arm=actuator(plant.right_arm),
        wrist=actuator(plant.wrist),
        supply=replace(supply, pressure=supply.pressure * about_1("supply pressure")),
        robot=replace(
            robot, left_arm=replace(left, inertia=left.inertia * about_1("inertia")),
            shoulder_link=replace(link, inertia=link.inertia * about_1("inertia")),
            club=replace(club, head_mass=club.head_mass * about_1("inertia")),
        ),
        encoders=replace(
            plant.encoders, noise=spread * NOISE * float(random.uniform()),
            jitter=spread * JITTER * float(random.uniform()),
        ),
        seed=seed + 1,
    )  # fmt: skip


def swing(plant: PlantParameters, parameters: ControlParameters, profile: Profile, *, ball: bool) -> Cause:
    """Return what stopped a swing of `plant`; NONE when it came back to its address."""
    bench = Lockstep(build_plant(plant), parameters, hanging_pose(plant))
    control = bench.state.control
    bench.advance(200)
    if bench.arm():
        control["tee"] = ball
        bench.advance(400)
        bench.advance(len(profile.angle), SWING)
        for _ in range(_LONGEST_RETURN // _CHUNK):
            if control["cause"][0] or control["phase"][0] == Phase.HOLD:
                break
            bench.advance(_CHUNK)
    cause = Cause(int(control["cause"][0]))
    return cause if cause or control["phase"][0] == Phase.HOLD else Cause.ADDRESS_TIMEOUT


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return how many swings were stopped, and by what."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks healthy_swings")
    parser.add_argument("--swings", type=int, default=1000)
    parser.add_argument("--spread", type=float, default=1.0, help="Times the tolerances.")
    options = parser.parse_args(arguments)
    c = load_configuration(shipped_configuration())
    profile = load_profile(find_profile(c.swing.profile))
    envelope = replace(c.envelope, model=replace(c.envelope.model, check="always"))
    parameters = build_controller(c.plant, profile, c.control, envelope, c.estimator)
    found: Counter[Cause] = Counter()
    seeds = track(range(options.swings), "swinging", console=Console(stderr=True), transient=True)
    for seed in seeds:
        plant = drawn_plant(c.plant, seed, options.spread)
        found[swing(plant, parameters, profile, ball=seed % 4 != 3)] += 1
    trips = {cause.name: count for cause, count in found.items() if cause}
    note = f"of {options.swings} at {options.spread:g} times the tolerances" + (f": {trips}" if trips else "")
    promised = 0 if options.spread <= 1.0 else None
    return [
        Row(
            "healthy_swings", "stopped without a fault", sum(trips.values()), "swings", note, at_most=promised
        )
    ]
