"""Stops during which a part breaks, and stops of healthy robots, which must not be escalated.

    python -m tests.benchmarks during_stops [--profile tour-male] [--shift 3] [--delays 45 80 130]
    python -m tests.benchmarks during_stops --healthy 500 [--profile tour-male]

At instants over the whole swing a stop is requested; `--delays` (ms) later a part breaks, and the robot
is watched until it rests. A row is a kind of fault: how many of its cases end unsafe, and the worst load.
The table's cases are known: `--shift` (ms) moves all instants, and other delays are new cases.
`--check off` leaves the model-based check out.

With `--healthy` nothing breaks: each stop is of another plant, a `healthy_plant` of its seed, at an instant
drawn over the swing, and ends as the stopping table says, without another cause.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from bench.base.errors import Refused
from bench.base.lifecycle import Cause, Phase, Reaction, Request
from bench.config import Configuration
from bench.control.settings import build_controller
from bench.faults.catalogue import Instant, instants_of
from bench.faults.matrix import Workbench
from bench.simulation.lockstep import Lockstep
from bench.simulation.plant_variation import healthy_plant
from bench.simulation.safety import RunEnd, SafetyLimits, unsafe_reasons
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.profile import Profile, load_profile
from drivers.base import JOINTS
from sim.driver import hanging_pose
from sim.faults import Fault, own_records
from sim.plant import build_plant
from tests.benchmarks.row import Row
from tests.benchmarks.swept import add_machine_options, machine_of, swept

STOPS = {
    "operator stop": Cause.OPERATOR_STOP,
    "emergency stop": Cause.EMERGENCY_STOP,
    "guard opened": Cause.GUARD,
}
"""Stops and their causes."""
AS_THE_TABLE_SAYS = frozenset({Reaction.NONE, Reaction.COMPLETE, Reaction.BRAKE, Reaction.VENT})
"""Reactions of a stop during which nothing breaks."""
DELAYS = (10, 30, 60, 100, 200)
"""ms from the stop to the fault."""
PHASES = ("backswing", "top", "downswing", "committed", "impact", "follow-through")
LONGEST, STILL = 14000, 1500
"""Ticks."""


class Break(NamedTuple):
    """A part that breaks, and the row of the table to which it belongs."""

    kind: str
    signal: str
    fault: Fault


def breaks() -> tuple[Break, ...]:
    """Return what breaks during the stops."""
    found = []
    for joint in JOINTS:
        valve, encoder = f"{joint} valve", f"{joint} encoder"
        found += [
            Break("valve stuck open", valve, Fault(f"{valve} stuck open", valve, "stuck", 1.0)),
            Break(
                "valve stuck open in reverse", valve, Fault(f"{valve} stuck reverse", valve, "stuck", -1.0)
            ),
            Break("valve 30 % off its centre", valve, Fault(f"{valve} offset", valve, "offset", 0.3)),
            Break("encoder lost", encoder, Fault(f"{encoder} off", encoder, "off")),
            Break("encoder stuck", encoder, Fault(f"{encoder} stuck", encoder, "stuck")),
        ]
    found.append(Break("supply valve stuck shut", "supply", Fault("supply shut", "supply", "stuck", 0.0)))
    return tuple(found)


class StopCase(NamedTuple):
    """A stop with a fault in it, and its end."""

    instant: str
    stop: str
    delay: int
    """ms from the stop to the fault."""
    kind: str
    fault: str
    stop_share: float
    """Energy of the most loaded cushion as a share of its rating."""
    cushion: str
    unsafe: tuple[str, ...]
    reactions: tuple[tuple[int, str], ...]
    """Changes of the reaction, each with its tick."""


def stopped(workbench: Workbench, instant: Instant, stop: str, fault: Fault | None) -> LockstepEngine:
    """Return the bench at rest after `stop` at `instant` and `fault`; its record begins at the stop."""
    bench = workbench.base(instant)
    bench.stepper.plant = own_records(bench.stepper.plant)
    if fault is not None:
        bench.stepper.break_with((fault,), watchdog=workbench.configuration.driver.watchdog)
    stop_and_rest(bench, stop)
    return bench


def stop_and_rest(bench: LockstepEngine, stop: str) -> None:
    """Stop `bench` and run it until it rests; its record and tally begin at the stop."""
    bench.reset_peaks()
    bench.begin_record()
    if stop == "emergency stop":
        bench.plant_state["emergency_stop_clear"] = False
    elif stop == "guard opened":
        bench.plant_state["guard_closed"] = False
    bench.advance(1, Request.STOP if stop == "operator stop" else 0)
    for _ in range(LONGEST // 100):
        bench.advance(100)
        if bench.phase is Phase.STANDING and rested(bench) >= STILL:
            break


def rested(bench: LockstepEngine) -> int:
    """Return for how many ticks all joints have rested."""
    moving = np.flatnonzero((np.abs(bench.record()["plant_velocity"]) > 0.2).any(axis=1))
    return len(bench.record()) - 1 - (int(moving[-1]) if len(moving) else -1)


def unsafe(bench: LockstepEngine) -> list[str]:
    """Return why the end of a stop is unsafe; empty when it is safe."""
    return unsafe_reasons(RunEnd(bench.loads(), rested=rested(bench) >= STILL), SafetyLimits())


def reactions(bench: LockstepEngine) -> tuple[tuple[int, str], ...]:
    """Return the changes of the reaction in the bench's record, each with its tick."""
    taken = bench.record()["reaction"]
    changes = np.flatnonzero(np.diff(taken, prepend=0))
    return tuple((int(k), Reaction(int(taken[k])).name) for k in changes)


def named_instants(profile: Profile, shift: int) -> list[Instant]:
    """Return the fault matrix' instants of the swing, `shift` ticks later."""
    named = [instant for instant in instants_of(profile) if instant.phase in PHASES]
    return [replace(instant, tick=max(instant.tick + shift, 1)) for instant in named]


StopDraw = tuple[Instant, str, Break, int]
"""Instant, stop, what breaks, and ms from the stop to that."""


@dataclass(frozen=True)
class Stops:
    """Stops in which something breaks."""

    configuration: Configuration
    profile: Profile
    model_check: bool

    def prepared(self) -> Callable[[StopDraw], StopCase]:
        """Return the function of a case."""
        workbench = Workbench(self.configuration, self.profile, model_check=self.model_check)

        def ended(draw: StopDraw) -> StopCase:
            instant, stop, broken, delay = draw
            bench = stopped(workbench, instant, stop, replace(broken.fault, time=1e-3 * delay))
            loads, why = bench.loads(), tuple(unsafe(bench))
            return StopCase(
                instant.name,
                stop,
                delay,
                broken.kind,
                broken.fault.name,
                round(loads.stop_share, 3),
                loads.stop,
                why,
                reactions(bench),
            )

        return ended


@dataclass(frozen=True)
class HealthyStops:
    """How stops of robots around the configured one are escalated, by seed."""

    configuration: Configuration
    profile: Profile

    def prepared(self) -> Callable[[int], str]:
        """Return the function of a seed."""
        return lambda seed: healthy_stop(self.configuration, self.profile, seed)


def healthy_stop(c: Configuration, profile: Profile, seed: int) -> str:
    """Return how the stop of the robot of `seed` was escalated; empty if it was not, or did not begin."""
    random = np.random.default_rng(seed)
    plant = healthy_plant(c.plant, seed)
    envelope = c.envelope.with_model_check("always")
    parameters = build_controller(c.plant, profile, c.control, envelope, c.estimator)
    bench = LockstepEngine(Lockstep(build_plant(plant), parameters, hanging_pose(plant)))
    stop = list(STOPS)[seed % len(STOPS)]
    bench.advance(200)
    with suppress(Refused):
        bench.arm()
        bench.control["tee"] = seed % 4 != 3
        bench.advance(400)
        if bench.start_swing(60, 50):
            bench.advance(int(random.integers(1, len(profile.angle))))
    if bench.cause or bench.phase in (Phase.STANDING, Phase.HOLD):
        return "did not begin"
    stop_and_rest(bench, stop)
    taken = set(bench.record()["reaction"].tolist())
    last = Cause(int(bench.control["latest_cause"][0]))
    return "" if taken <= AS_THE_TABLE_SAYS and last is STOPS[stop] else f"{last.name} (seed {seed})"


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return how many stops end unsafe, by kind of fault, or how many of healthy robots are escalated."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks during_stops")
    parser.add_argument("--delays", type=int, nargs="+", default=DELAYS, metavar="MS")
    parser.add_argument("--shift", type=int, default=0, metavar="MS", help="Move all instants.")
    parser.add_argument("--stops", nargs="+", default=list(STOPS), choices=list(STOPS))
    parser.add_argument("--faults", default="", metavar="PART", help="Only those with it in their name.")
    parser.add_argument("--healthy", type=int, default=0, metavar="N", help="Stop N healthy robots.")
    add_machine_options(parser)
    options = parser.parse_args(arguments)
    c, file = machine_of(options)
    profile = load_profile(file)
    if options.healthy:
        seeds = range(options.first, options.first + options.healthy)
        return [_escalated(swept(options, HealthyStops(c, profile), seeds, "stopping", c), profile, seeds)]
    instants = named_instants(profile, options.shift)
    wanted = [broken for broken in breaks() if options.faults in broken.fault.name]
    draws = list(product(instants, options.stops, wanted, options.delays))
    study = Stops(c, profile, options.check == "always")
    found = swept(options, study, draws, "stopping", c, group=lambda draw: draw[0])
    return [
        _summary(kind, [case for case in found if case.kind == kind])
        for kind in dict.fromkeys(case.kind for case in found)
    ]


def _summary(kind: str, of_kind: Sequence[StopCase]) -> Row:
    bad = [case for case in of_kind if case.unsafe]
    worst = max(of_kind, key=lambda case: case.stop_share)
    note = f"of {len(of_kind)}; worst load {100 * worst.stop_share:.0f} % ({worst.cushion}): {worst.fault}, "
    note += f"{worst.delay} ms after {worst.stop}, {worst.instant}"
    return Row("during_stops", f"unsafe after a stop with {kind}", len(bad), "stops", note)


def _escalated(ends: Sequence[str], profile: Profile, seeds: range) -> Row:
    begun = [end for end in ends if end != "did not begin"]
    escalated = [end for end in begun if end]
    note = f"of {len(begun)} of {profile.name!r} from seed {seeds[0]}; {len(ends) - len(begun)} did not begin"
    note += f": {', '.join(escalated[:4])}" if escalated else ""
    return Row("during_stops", "healthy stops escalated", len(escalated), "stops", note, at_most=0)
