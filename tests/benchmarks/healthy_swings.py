"""No false alarms: swings of plants that differ within their tolerances, the controller as it was designed.

    python -m tests.benchmarks healthy_swings [--swings 1000] [--first 0] [--spread 1.0]
        [--homing | --stops | --access]

Each swing is of another plant, drawn from its seed, from the hanging pose over arming, address and swing to
the return; every fourth has no ball. `--first` is the first seed, `--spread` widens or narrows all
tolerances, `--homing` searches the encoders' index in place of swinging. `--stops` swings each robot twice
and stops copies of it in every phase, by request or emergency stop, which may not escalate; one of them is
armed again from where it came to rest. `--access` arms,
vents, releases the guard and secures it. `--check off` leaves out the model-based check; `--configuration`
and `--profile` take another machine and swing, with the club of that swing.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.base.errors import Refused
from bench.base.lifecycle import Cause, Phase, Request, State
from bench.control.settings import build_controller
from bench.control.step_records import ControlParameters, new_control_state
from bench.simulation.lockstep import Lockstep
from bench.simulation.plant_variation import HealthyRun, healthy_plant, healthy_run
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.profile import Profile, load_profile
from sim.driver import hanging_pose
from sim.plant import PlantParameters, build_plant
from tests.benchmarks.row import Row
from tests.benchmarks.swept import add_machine_options, machine_of, swept

NAME = "healthy_swings"
INDEX_FROM_HANGING = (0.6, 0.4, 0.4)
"""rad from the hanging pose to where each encoder's index is."""
_CHUNK, _LONGEST_RETURN, _LONGEST_SEARCH = 500, 12_000, 80_000
_LONGEST_VENT = 20.0
"""s"""


def swing(plant: PlantParameters, parameters: ControlParameters, profile: Profile, *, ball: bool) -> Cause:
    """Return what stopped a swing of `plant`; NONE when it came back to its address."""
    bench = Lockstep(build_plant(plant), parameters, hanging_pose(plant))
    control = bench.state.control
    bench.advance(200)
    with suppress(Refused):
        engine = LockstepEngine(bench)
        engine.arm()
        control["tee"] = ball
        bench.advance(400)
        engine.await_air()
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


def let_in(plant: PlantParameters, parameters: ControlParameters) -> Cause:
    """Return what stopped a venting, or an access after it; NONE when it ended in READY."""
    stepper = Lockstep(build_plant(plant), parameters, hanging_pose(plant))
    bench = LockstepEngine(stepper)
    bench.advance(200)
    with suppress(Refused):
        bench.arm()
        bench.advance(400)
        bench.request(Request.DISARM)
        bench.wait_for(lambda: bool(bench.control["vented"][0]), _LONGEST_VENT)
        bench.request(Request.ACCESS)
        bench.plant_state["guard_closed"] = False
        bench.advance(2000)
        bench.plant_state["guard_closed"] = True
        bench.advance(100)
        bench.request(Request.SECURE)
        bench.advance(2500)
    state = State(int(bench.control["state"][0]))
    return bench.cause if bench.cause or state is State.READY else Cause.NOT_VENTED


@dataclass(frozen=True)
class HealthyRobots:
    """What stops robots around `plant` without a fault, by seed."""

    plant: PlantParameters
    parameters: ControlParameters
    profile: Profile
    spread: float
    kind: str
    """swing, stops (two swings, and stops of copies), homing or access."""

    def prepared(self) -> Callable[[int], Any]:
        """Return the function of a seed: a Cause; with stops a HealthyRun or None."""

        def stopped_by(seed: int) -> Cause | HealthyRun | None:
            plant = healthy_plant(self.plant, seed, self.spread)
            if self.kind == "stops":
                return healthy_run(plant, self.parameters, self.profile, seed)
            if self.kind == "homing":
                return search(plant, self.parameters)
            if self.kind == "access":
                return let_in(plant, self.parameters)
            return swing(plant, self.parameters, self.profile, ball=seed % 4 != 3)

        return stopped_by


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return how many swings were stopped, and by what."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks healthy_swings")
    parser.add_argument("--swings", type=int, default=1000)
    parser.add_argument("--homing", action="store_true", help="Search the indices in place of swinging.")
    parser.add_argument(
        "--stops", action="store_true", help="Swing each robot twice, and stop it on the way."
    )
    parser.add_argument("--access", action="store_true", help="Vent and release the guard instead.")
    add_machine_options(parser)
    parser.add_argument("--spread", type=float, default=1.0, help="Times the tolerances.")
    options = parser.parse_args(arguments)
    c, file = machine_of(options)
    profile = load_profile(file)
    c = replace(c.with_club(profile.club), envelope=c.envelope.with_model_check(options.check))
    limits = Path(c.limits_in_use(profile, file).source).name if options.check != "off" else "none"
    c = c.for_profile(profile, file)
    nominal = counting(c.plant) if options.homing else c.plant
    homing = replace(c.homing, method="index")
    parameters = build_controller(nominal, profile, c.control, c.envelope, c.estimator, homing=homing)
    note = f"{profile.name}, check {options.check}, limits: {limits}, seeds from {options.first}"
    note += f", {options.spread:g} times the tolerances"
    promised = 0 if options.spread <= 1.0 else None
    seeds = range(options.first, options.first + options.swings // (2 if options.stops else 1))
    kind = next((name for name in ("stops", "homing", "access") if getattr(options, name)), "swing")
    robots = HealthyRobots(nominal, parameters, profile, options.spread, kind)
    causes = swept(options, robots, seeds, kind, c)
    if options.stops:
        return _with_stops(causes, seeds, note, promised)
    stopped = [f"{cause.name} (seed {seed})" for cause, seed in zip(causes, seeds, strict=True) if cause]
    note += f": {', '.join(stopped[:4])}" if stopped else ""
    name = f"stopped without a fault, of {len(seeds)}"
    return [Row(NAME, name, len(stopped), "", note, at_most=promised)]


def _with_stops(
    runs: Sequence[HealthyRun | None], seeds: range, note: str, promised: int | None
) -> list[Row]:
    """Return how many of two swings of each robot were stopped, and how many stops of it escalated."""
    stopped, escalated, rearmed, stops = list[str](), list[str](), list[str](), 0
    for made, seed in zip(runs, seeds, strict=True):
        if made is None or made.cause:
            cause = Cause.ADDRESS_TIMEOUT if made is None else made.cause
            stopped.append(f"{cause.name} (seed {seed})")
        if made is not None:
            stops += made.stops
            for text in made.escalated:
                (rearmed if "armed again" in text else escalated).append(f"{text} (seed {seed})")
    return [
        Row(
            NAME,
            f"{what}, of {number}",
            len(found),
            "",
            note + (f": {', '.join(found[:4])}" if found else ""),
            at_most=promised,
        )
        for what, number, found, promised in (
            ("stopped without a fault", 2 * len(seeds), stopped, promised),
            ("stops that escalated without a fault", stops, escalated, promised),
            ("stops after which arming was stopped", stops, rearmed, None),
        )
    ]
