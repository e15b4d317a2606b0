"""Zeros that are wrong: which of them homing finds, and what the swing does after one that it lets pass.

    python -m tests.benchmarks homing_offsets [--offsets 0.02,0.05,0.1,0.15,0.3] [--profile NAME]

Each case turns the zeros of one joint, or of all three at once, by an offset of either sign, on absolute
encoders and on incremental ones with an index; then it homes, arms and swings. All is judged by the plant.
`--spread` draws the robot within so many times its tolerances; `--processes`, `--cluster` choose the engine.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from rich.console import Console

from bench.config import Configuration, load_configuration, shipped_configuration
from bench.control.records import new_control_state
from bench.control.settings import build_controller
from bench.errors import Refused
from bench.lifecycle import Cause, Phase, Request, State
from bench.simulation.engine import LockstepEngine
from bench.simulation.lockstep import Lockstep
from bench.simulation.safety import RunEnd, SafetyLimits, dangers
from bench.simulation.variation import healthy_plant
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from drivers.base import JOINTS
from sim.driver import hanging_pose
from sim.plant import build_plant
from tests.benchmarks.healthy_swings import counting
from tests.benchmarks.row import Row
from tests.benchmarks.swept import add_engine_options, swept

FOUND_FROM = 0.05
"""rad, from which on an offset of one joint must be found."""
_VENTED, _LONGEST_HOMING, _LONGEST_RETURN, _CHUNK = 3000, 90_000, 12_000, 500


class Ending(NamedTuple):
    """How a case ended."""

    cause: Cause
    """What homing found; NONE if it ended in READY."""
    seconds: float
    """Duration of homing, s."""
    swung: bool
    clearance: float
    """Least distance of the sole from the ground since homing, m; a negative one is in the ground."""
    unsafe: tuple[str, ...]


def home_and_swing(
    c: Configuration,
    profile: Profile,
    offset: tuple[float, float, float],
    *,
    incremental: bool,
    seed: int = 0,
    spread: float = 1.0,
) -> Ending:
    """Return how homing ends whose encoders read `offset` rad too much, and the swing after it."""
    nominal = counting(c.plant) if incremental else c.plant
    homing = replace(c.homing, method="index" if incremental else "absolute")
    parameters = build_controller(nominal, profile, c.control, c.envelope, c.estimator, homing=homing)
    encoders = nominal.encoders
    shift = np.floor(
        np.array(offset) * np.array(encoders.sign) * encoders.counts_per_revolution / (2 * np.pi)
    )
    zeros = np.array(encoders.zero_count) + shift
    plant = healthy_plant(c.plant, seed, spread)
    encoders = replace(
        plant.encoders,
        incremental=incremental,
        zero_count=(float(zeros[0]), float(zeros[1]), float(zeros[2])),
    )
    bench = Lockstep(build_plant(replace(plant, encoders=encoders)), parameters, hanging_pose(plant))
    bench.state = new_control_state(State.SAFE)
    engine, control = LockstepEngine(bench), bench.state.control
    bench.advance(_VENTED)
    begin = bench.tick
    bench.advance(1, Request.HOME)
    while control["state"][0] == State.HOMING and bench.tick - begin < _LONGEST_HOMING:
        bench.advance(_CHUNK)
    seconds = (bench.tick - begin) * engine.period
    if control["state"][0] != State.READY:
        return Ending(engine.cause or Cause.HOMING_FAILED, seconds, False, np.inf, ())
    swung = False
    bench.advance(_VENTED)
    engine.begin_tally()
    with suppress(Refused):
        engine.arm()
        control["tee"] = True
        bench.advance(400)
        swung = engine.start_swing(10, 300)
        bench.advance(len(profile.angle))
        for _ in range(_LONGEST_RETURN // _CHUNK):
            if control["phase"][0] in (Phase.HOLD, Phase.STANDING):
                break
            bench.advance(_CHUNK)
    loads = engine.loads()
    unsafe = tuple(dangers(RunEnd(loads), SafetyLimits()))
    return Ending(Cause.NONE, seconds, swung, loads.lowest_clearance, unsafe)


@dataclass(frozen=True)
class WrongZeros:
    """Homing and a swing with zeros that are wrong, by offsets (rad) and whether encoders are incremental."""

    configuration: Configuration
    profile: Profile
    seed: int
    spread: float

    def prepared(self) -> Callable[[tuple[tuple[float, float, float], bool]], Ending]:
        """Return the function of offsets and kind of encoder."""
        return lambda case: home_and_swing(
            self.configuration,
            self.profile,
            case[0],
            incremental=case[1],
            seed=self.seed,
            spread=self.spread,
        )


def cases(offsets: Sequence[float]) -> Iterator[tuple[str, float, tuple[float, float, float]]]:
    """Yield name, size and offsets (rad) of each case: every joint alone, and all together in all signs."""
    for size in offsets:
        for joint, sign in product(range(3), (1, -1)):
            offset = [0.0, 0.0, 0.0]
            offset[joint] = sign * size
            yield f"{JOINTS[joint]} {sign * size:+g}", size, (offset[0], offset[1], offset[2])
        for signs in product((1, -1), repeat=3):
            a, b, s = (sign * size for sign in signs)
            yield f"all {a:+g} {b:+g} {s:+g}", size, (a, b, s)


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return for each offset how many cases were found, and the least clearance of those that were not."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks homing_offsets")
    parser.add_argument("--offsets", default="0.01,0.02,0.03,0.04,0.05,0.1,0.15,0.3", help="rad")
    parser.add_argument("--profile", default="", help="Name or path; else the configuration's.")
    parser.add_argument("--seed", type=int, default=0, help="Of the robot; 0 is the nominal one.")
    parser.add_argument("--spread", type=float, default=1.0, help="Times the tolerances.")
    add_engine_options(parser)
    options = parser.parse_args(arguments)
    c = load_configuration(shipped_configuration())
    profile = load_profile(find_profile(options.profile or c.swing.profile))
    sizes = [float(text) for text in options.offsets.split(",")]
    console = Console(stderr=True)
    table = [(*case, incremental) for case in cases(sizes) for incremental in (False, True)]
    ends: list[tuple[float, bool, bool, Ending]] = []
    study = WrongZeros(c, profile, options.seed, options.spread)
    endings = swept(options, study, [(offset, incremental) for *_, offset, incremental in table], "homing", c)
    for (name, size, _, incremental), end in zip(table, endings, strict=True):
        kind = "index" if incremental else "absolute"
        text = f"{kind}, {name} rad: " + (
            end.cause.name if end.cause else f"READY, swung {end.swung}, {1e3 * end.clearance:.1f} mm"
        )
        console.print(f"{text} {'; '.join(end.unsafe)} ({end.seconds:.1f} s)", highlight=False)
        ends.append((size, incremental, name.startswith("all"), end))
    rows = []
    for size, incremental in product(sizes, (False, True)):
        of = [(together, end) for s, i, together, end in ends if (s, i) == (size, incremental)]
        missed = [end for _, end in of if not end.cause]
        least = min((1e3 * end.clearance for end in missed), default=np.inf)
        note = f"least clearance of the others {least:.1f} mm" if missed else ""
        name = f"{'index' if incremental else 'absolute'} {size:g} rad"
        promised = len(of) if size >= FOUND_FROM else None
        rows.append(
            Row("homing_offsets", f"{name}: found", len(of) - len(missed), f"of {len(of)}", note, promised)
        )
    unsafe = sum(bool(end.unsafe) for *_, end in ends)
    return [*rows, Row("homing_offsets", "unsafe swings", unsafe, "", at_most=0)]
