"""No false alarms: swings of plants that differ within their tolerances, the controller as it was designed.

    python -m tests.benchmarks healthy_swings [--swings 1000] [--first 0] [--spread 1.0] [--homing]

Each swing is of another plant, drawn from its seed, from the hanging pose over arming, address and swing to
the return; every fourth has no ball. `--first` is the first seed, `--spread` widens or narrows all
tolerances, `--homing` searches the encoders' index in place of swinging. `--check off` leaves out the
model-based check; `--configuration` and `--profile` take another machine and swing.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from bench.config import load_configuration, shipped_configuration
from bench.control.records import ControlParameters, new_control_state
from bench.control.settings import build_controller
from bench.errors import Refused
from bench.lifecycle import Cause, Phase, Request, State
from bench.simulation.engine import LockstepEngine
from bench.simulation.lockstep import Lockstep
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.driver import hanging_pose
from sim.plant import PlantParameters, build_plant
from sim.pneumatics import Actuator
from tests.benchmarks.row import Row

TOLERANCE = {
    "conductance": 0.025,
    "spool frequency": 0.05,
    "dead band": 0.15,
    "friction": 0.15,
    "dead volume": 0.05,
    "supply pressure": 0.01,
    "inertia": 0.01,
}
"""Shares of the nominal value; assumption: what calibration and a good maker leave."""
CENTRE = 0.0015
"""Of a valve, in openings."""
LEAKAGE = 2.0
"""Leakages are up to so many times their nominal value above and 1 below it."""
NOISE, JITTER = 1e-5, 2e-6
"""Of the encoders at most, rad and s."""
INDEX_FROM_HANGING = (0.6, 0.4, 0.4)
"""rad from the hanging pose to where each encoder's index is."""
_CHUNK, _LONGEST_RETURN, _LONGEST_SEARCH = 500, 12_000, 80_000


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
            a.valve,
            conductance=a.valve.conductance * about_1("conductance"),
            natural_frequency=a.valve.natural_frequency * about_1("spool frequency"),
            dead_band=a.valve.dead_band * about_1("dead band"),
            leakage=a.valve.leakage * leaking(),
            centre=spread * CENTRE * float(random.uniform(-1.0, 1.0)),
        )
        return replace(
            a,
            dead_volume=a.dead_volume * about_1("dead volume"),
            cross_leakage=a.cross_leakage * leaking(),
            friction=friction,
            valve=valve,
        )

    robot, supply = plant.robot, plant.supply
    left, link, club = robot.left_arm, robot.shoulder_link, robot.club
    return replace(
        plant,
        shoulder=actuator(plant.shoulder),
        right_arm=actuator(plant.right_arm),
        wrist=actuator(plant.wrist),
        supply=replace(supply, pressure=supply.pressure * about_1("supply pressure")),
        robot=replace(
            robot,
            left_arm=replace(left, inertia=left.inertia * about_1("inertia")),
            shoulder_link=replace(link, inertia=link.inertia * about_1("inertia")),
            club=replace(club, head_mass=club.head_mass * about_1("inertia")),
        ),
        encoders=replace(
            plant.encoders,
            noise=spread * NOISE * float(random.uniform()),
            jitter=spread * JITTER * float(random.uniform()),
        ),
        seed=seed + 1,
    )


def swing(plant: PlantParameters, parameters: ControlParameters, profile: Profile, *, ball: bool) -> Cause:
    """Return what stopped a swing of `plant`; NONE when it came back to its address."""
    bench = Lockstep(build_plant(plant), parameters, hanging_pose(plant))
    control = bench.state.control
    bench.advance(200)
    with suppress(Refused):
        LockstepEngine(bench).arm()
        control["tee"] = ball
        bench.advance(400)
        bench.advance(len(profile.angle), Request.SWING)
        for _ in range(_LONGEST_RETURN // _CHUNK):
            if control["cause"][0] or control["phase"][0] == Phase.HOLD:
                break
            bench.advance(_CHUNK)
    cause = Cause(int(control["cause"][0]))
    return cause if cause or control["phase"][0] == Phase.HOLD else Cause.ADDRESS_TIMEOUT


def counting(plant: PlantParameters) -> PlantParameters:
    """Return `plant` with encoders that count from switching on, and their indices in the search's way."""
    counts = plant.encoders.counts_per_revolution
    a, b, c = (
        float(np.floor(-angle * counts / (2 * np.pi))) for angle in hanging_pose(plant) - INDEX_FROM_HANGING
    )
    return replace(plant, encoders=replace(plant.encoders, incremental=True, zero_count=(a, b, c)))


def search(plant: PlantParameters, parameters: ControlParameters) -> Cause:
    """Return what stopped the search of the encoders' indices; NONE when all were found."""
    bench = Lockstep(build_plant(plant), parameters, hanging_pose(plant))
    bench.state = new_control_state(State.SAFE)
    control = bench.state.control
    bench.advance(20)
    bench.advance(1, Request.HOME)
    for _ in range(_LONGEST_SEARCH // _CHUNK):
        if control["state"][0] != State.HOMING:
            break
        bench.advance(_CHUNK)
    cause = Cause(int(control["cause"][0]))
    return cause if cause or control["state"][0] == State.READY else Cause.HOMING_FAILED


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return how many swings were stopped, and by what."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks healthy_swings")
    parser.add_argument("--swings", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="Seed of the first.")
    parser.add_argument("--homing", action="store_true", help="Search the indices in place of swinging.")
    parser.add_argument("--check", choices=("always", "off"), default="always", help="By the model.")
    parser.add_argument("--configuration", default="", help="Name or path; else the shipped one.")
    parser.add_argument("--profile", default="", help="Name or path; else the configuration's.")
    parser.add_argument("--spread", type=float, default=1.0, help="Times the tolerances.")
    options = parser.parse_args(arguments)
    c = load_configuration(Path(options.configuration) if options.configuration else shipped_configuration())
    profile = load_profile(find_profile(options.profile or c.swing.profile))
    envelope = replace(c.envelope, model=replace(c.envelope.model, check=options.check))
    nominal = counting(c.plant) if options.homing else c.plant
    homing = replace(c.homing, method="index")
    parameters = build_controller(nominal, profile, c.control, envelope, c.estimator, homing=homing)
    stopped: list[str] = []
    last = options.first + options.swings
    seeds = track(range(options.first, last), "swinging", console=Console(stderr=True), transient=True)
    for seed in seeds:
        plant = drawn_plant(c.plant, seed, options.spread)
        if options.homing:
            encoders = replace(plant.encoders, incremental=True, zero_count=nominal.encoders.zero_count)
            cause = search(replace(plant, encoders=encoders), parameters)
        else:
            cause = swing(plant, parameters, profile, ball=seed % 4 != 3)
        if cause:
            stopped.append(f"{cause.name} (seed {seed})")
    note = f"of {options.swings} from seed {options.first}, check {options.check}"
    note += f", {options.spread:g} times the tolerances" + (f": {', '.join(stopped[:4])}" if stopped else "")
    promised = 0 if options.spread <= 1.0 else None
    return [Row("healthy_swings", "stopped without a fault", len(stopped), "swings", note, at_most=promised)]
