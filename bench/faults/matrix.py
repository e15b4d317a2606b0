"""The whole matrix: a case from its instant to rest, the plan of the cases, and their run as a sweep."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import pi
from pathlib import Path
from typing import Any, TypeVar
from zlib import crc32

import numpy as np

from bench.base.errors import Refused
from bench.base.lifecycle import CAUSE_TEXT, Request, State
from bench.config import Configuration
from bench.control.settings import SIMULATED, holding_pressure
from bench.control.step_records import ControlParameters, new_control_state
from bench.faults._case_run import Watch, WatchedRun, next_swing
from bench.faults._verdict import CaseLimits, CaseOutcome, judge_case
from bench.faults.catalogue import (
    ACCESS,
    CATALOGUE,
    INTO_A_STOP,
    START,
    Breakage,
    Event,
    Instant,
    dense_instants,
    instants_of,
    irrelevant,
    stopped_instants,
)
from bench.simulation.lockstep import Lockstep
from bench.simulation.safety import SafetyLimits
from bench.simulation.simulated_bench import Bench
from bench.simulation.sweep import Engine, SweepStore, code_digest, sweep
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.driver import hanging_pose
from sim.faults import own_records, sort_of
from sim.plant import Plant, build_plant

Key = TypeVar("Key")
Value = TypeVar("Value")

_MAX_DURATION = 40.0
"""Longest watch of a case, s."""
_MAX_SEARCH_TIME = 30.0
"""Additional time for a case that starts in the search and continues to a swing, s."""
_MAX_ACCESS_TIME = 60.0
"""Additional time for a case that vents, releases the guard and continues to a swing, s."""
_KEPT = 8
"""Undisturbed benches and runs that are kept: a run has up to 90 s of records, a sweep goes by instants."""
_ASK_AFTER = 0.2
"""Time in hold or standing from the fault to the next request, s."""


class Workbench:
    """A plant, a profile and settings; each case begins in their undisturbed run."""

    def __init__(
        self, configuration: Configuration, profile: Profile, *, model_check: bool | None = None
    ) -> None:
        """Build plant and controllers; `model_check` overrides the configuration."""
        c = configuration
        if model_check is not None:
            c = replace(c, envelope=c.envelope.with_model_check("always" if model_check else "off"))
        self.profile, self.configuration, self._bench = profile, c, Bench.of(c, profile)
        self.plant: Plant = build_plant(c.plant)
        self._lifecycle = replace(
            c.lifecycle, warning_time=SIMULATED.warning_time, hold_between_swings=True, local_reset=True
        )
        self.parameters = self._bench.controller(self._lifecycle)
        self.period = c.plant.tick
        self._bases: dict[Instant, LockstepEngine] = {}
        self._ends: dict[tuple[Instant, Event, float], WatchedRun] = {}

    @cached_property
    def _homing(self) -> tuple[Plant, ControlParameters]:
        """The same machine with encoders that count from switching on, homed by their index."""
        c = self.configuration
        counts = c.plant.encoders.counts_per_revolution
        marks = hanging_pose(c.plant) + np.array([-0.6, -0.4, -0.4])
        a, b, c_ = (float(np.floor(-angle * counts / (2 * pi))) for angle in marks)
        encoders = replace(c.plant.encoders, incremental=True, zero_count=(a, b, c_))
        plant = replace(c.plant, encoders=encoders)
        homing = replace(c.homing, method="index")
        return build_plant(plant), replace(self._bench, plant=plant).controller(self._lifecycle, homing)

    @cached_property
    def _absolute(self) -> tuple[Plant, ControlParameters]:
        """The machine of the shipped configuration, homed by its hanging pose."""
        homing = replace(self.configuration.homing, method="absolute")
        return self.plant, self._bench.controller(self._lifecycle, homing)

    def base(self, instant: Instant) -> LockstepEngine:
        """Return the undisturbed bench at `instant`.

        Raises:
            Refused: the undisturbed bench does not get there.
        """
        instant = replace(instant, delay=0.0)
        if instant not in self._bases:
            _keep(self._bases, instant, self._brought_to(instant))
        return self._bases[instant].copy()

    def _brought_to(self, instant: Instant) -> LockstepEngine:
        plant, parameters, unhomed = self.plant, self.parameters, instant.phase in ("start", "homing")
        if unhomed:
            plant, parameters = self._absolute if instant.label == "absolute" else self._homing
        stepper = Lockstep(plant, parameters, hanging_pose(plant.parameters))
        bench = LockstepEngine(stepper, name=self.profile.name)
        if unhomed:
            stepper.state = new_control_state(State.SAFE)
            if instant.phase == "homing":
                bench.advance(20)
                bench.request(Request.HOME)
                bench.advance(instant.tick)
        else:
            bench.advance(200)
            if instant.phase != "standing":
                bench.arm()
                bench.control["tee"] = True
                bench.advance(400)
                bench.await_air()
                if instant.phase == "access":
                    if instant.label == "inside":
                        _enter(bench)
                elif instant.phase != "hold":
                    bench.advance(instant.tick, Request.SWING)
        if bench.cause:
            raise Refused(
                f"fault matrix of profile {self.profile.name!r}",
                f"the undisturbed bench stopped before {instant.name}: {CAUSE_TEXT[bench.cause]}",
                "an undisturbed swing that runs to its end",
                "Try it with `golfbench profile simulate`.",
            )
        return bench

    def run(self, breakage: Breakage, instant: Instant) -> CaseOutcome:
        """Return the outcome of `breakage` at `instant`, with the report of the next swing if undetected."""
        watch = self._watched(instant, breakage)
        healthy = self._healthy(instant, _event_of(breakage), breakage.event_after)
        outcome = judge_case(self._limits, breakage, instant, watch.run(), healthy)
        if outcome.verdict != "undetected":
            return outcome
        return replace(outcome, next_swing=next_swing(watch.bench))

    def _healthy(self, instant: Instant, event: Event, after: float = 0.0) -> WatchedRun:
        """Return the run from `instant` without a fault, with `event` (stop or missing ball) `after` s."""
        key = replace(instant, delay=0.0), event, after
        if key not in self._ends:
            _keep(self._ends, key, self._watched(key[0], None, event, after).run())
        return self._ends[key]

    @cached_property
    def _limits(self) -> CaseLimits:
        """Limits of all cases; the head may be as fast as undisturbed, with or without a ball."""
        hold = Instant("hold", 0)
        runs = [self._healthy(hold, event) for event in _WITH_AND_WITHOUT_BALL]
        safety = SafetyLimits(
            min_frame_distance=self.configuration.envelope.min_frame_distance,
            access_pressure=1.01 * holding_pressure(self.configuration.plant),
        )
        return CaseLimits(self.period, safety, max(run.loads.peak_head_speed for run in runs))

    def _watched(
        self, instant: Instant, breakage: Breakage | None, event: Event = "", after: float = 0.0
    ) -> Watch:
        """Run from `instant` until everything rests; without a `breakage` with `event` `after` s."""
        bench = self.base(instant)
        bench.stepper.plant = own_records(bench.stepper.plant)
        bench.reset_peaks()
        if breakage is not None:
            event, after = breakage.event, breakage.event_after
        if event == "no ball":
            bench.plant_state["ball_present"] = False
        if breakage is not None:
            later = tuple(replace(fault, time=fault.time + instant.delay) for fault in breakage.faults)
            bench.stepper.break_with(later, watchdog=self.configuration.driver.watchdog)
        watch = Watch(bench)
        event_at = round(after / self.period)
        watch.advance(event_at, 0)
        _bring_about(event, bench)
        watch.advance(round(_ASK_AFTER / self.period) - event_at, Request.STOP if event == "stop" else 0)
        longest = _MAX_DURATION + (_MAX_SEARCH_TIME if instant.phase in ("homing", "start") else 0.0)
        longest += _MAX_ACCESS_TIME if instant.phase == "access" else 0.0
        watch.until_rest(
            round(longest / self.period), _GOING_ON.get(instant.name, _GOING_ON.get(instant.phase, ()))
        )
        return watch


def _keep(kept: dict[Key, Value], key: Key, value: Value) -> None:
    """Keep `value`; drop the oldest of more than _KEPT."""
    kept[key] = value
    if len(kept) > _KEPT:
        del kept[next(iter(kept))]


_GOING_ON: dict[str, tuple[Request, ...]] = {
    "start": (Request.HOME, Request.ARM, Request.SWING),
    "standing": (Request.ARM, Request.SWING),
    "homing": (Request.ARM, Request.SWING),
    "hold": (Request.SWING,),
    "access before": (Request.DISARM, Request.ACCESS, Request.SECURE, Request.ARM, Request.SWING),
    "access inside": (Request.SECURE, Request.ARM, Request.SWING),
}
"""Requests that continue from an instant, by its name or phase."""
_WITH_AND_WITHOUT_BALL: tuple[Event, ...] = ("", "no ball")


def _event_of(breakage: Breakage) -> Event:
    """Return the event that the undisturbed run needs for a comparison with `breakage`.

    An event that shows a single fault is no part of it: it is noticed, or the switch that is stuck hides it.
    """
    return (
        breakage.event if breakage.event in ("stop", "no ball") or breakage.family == "during a stop" else ""
    )


def _bring_about(event: Event, bench: LockstepEngine) -> None:
    """Open the circuit of `event`."""
    if event == "guard opened":
        bench.plant_state["guard_closed"] = False
    elif event == "emergency stop":
        bench.plant_state["emergency_stop_clear"] = False


def _enter(bench: LockstepEngine) -> None:
    """Vent, release the guard and open it."""
    bench.request(Request.DISARM)
    while not bench.request(Request.ACCESS) and not bench.cause:
        bench.advance(100)
    bench.plant_state["guard_closed"] = False
    bench.advance(500)


MatrixCase = tuple[Breakage, Instant]
OutcomeStore = SweepStore[CaseOutcome]


@dataclass(frozen=True)
class Skipped:
    """A pair that cannot matter, with its rule."""

    breakage: str
    signal: str
    kind: str
    family: str
    instant: str
    phase: str
    rule: str


@dataclass(frozen=True)
class MatrixPlan:
    """Cases to run, and pairs left out."""

    cases: tuple[MatrixCase, ...]
    skipped: tuple[Skipped, ...]
    every: int = 1
    """One of so many cases was drawn."""


def instants_for(breakage: Breakage, profile: Profile) -> tuple[Instant, ...]:
    """Return the instants at which `breakage` is tried."""
    of_motion = sort_of(breakage.fault.signal) in ("valve", "encoder")
    if breakage.family == "during a stop":
        return stopped_instants(profile, INTO_A_STOP if of_motion else INTO_A_STOP[1::2])
    if breakage.family == "from the start":
        return START
    if breakage.family == "latent pair":
        return instants_of(profile)[:1]
    if breakage.family == "access":
        return ACCESS
    dense = of_motion and breakage.fault.kind in ("stuck", "off")
    return instants_of(profile) + (dense_instants(profile) if dense else ())


def plan_matrix(
    profile: Profile,
    *,
    model_check: bool,
    signals: Sequence[str] = (),
    phases: Sequence[str] = (),
    families: Sequence[str] = (),
    one_instant: bool = False,
    every: int = 1,
) -> MatrixPlan:
    """Return the cases of `profile`.

    They are narrowed by `signals` (parts of names), `phases`, `families`, `one_instant` of each phase, and to
    one case of `every`, at least one of each breakage.
    """
    cases: list[MatrixCase] = []
    skipped = []
    for breakage in CATALOGUE:
        if signals and not any(part in breakage.name for part in signals):
            continue
        if families and breakage.family not in families:
            continue
        instants = instants_for(breakage, profile)
        if one_instant:
            instants = _middle_ones(instants)
        for instant in instants:
            if phases and instant.phase not in phases:
                continue
            if rule := irrelevant(breakage, instant.phase, model_check=model_check):
                f = breakage.fault
                skipped.append(
                    Skipped(
                        breakage.name, f.signal, f.kind, breakage.family, instant.name, instant.phase, rule
                    )
                )
            else:
                cases.append((breakage, instant))
    by_lot = sorted(cases, key=lambda case: _drawn(*case) % every, reverse=True)
    first = {breakage.name: instant for breakage, instant in by_lot}
    drawn = tuple(c for c in cases if _drawn(*c) % every == 0 or (every > 1 and first[c[0].name] is c[1]))
    return MatrixPlan(drawn, tuple(skipped), every)


def _drawn(breakage: Breakage, instant: Instant) -> int:
    """Return a number of a case that says nothing of it, and is the same in every run."""
    return crc32(f"{breakage.name} {instant.name}".encode())


def _middle_ones(instants: Sequence[Instant]) -> tuple[Instant, ...]:
    """Return the middle one of `instants` in each phase."""
    by_phase: dict[str, list[Instant]] = {}
    for instant in instants:
        by_phase.setdefault(instant.phase, []).append(instant)
    return tuple(of_phase[len(of_phase) // 2] for of_phase in by_phase.values())


def digest_of(configuration: Configuration, profile: Profile, model_check: bool) -> str:
    """Return the digest of all that results depend on: sources, plant, settings, profile."""
    effective = configuration.effective()
    parts = {
        name: effective[name]
        for name in ("plant", "control", "lifecycle", "homing", "envelope", "estimator", "driver")
    }
    text = json.dumps([code_digest(__name__), repr(CATALOGUE), parts, model_check], sort_keys=True)
    return hashlib.sha256(text.encode() + profile.angle.tobytes() + profile.valve.tobytes()).hexdigest()[:16]


def outcome_of(record: dict[str, Any]) -> CaseOutcome:
    """Return the outcome of a record of `CaseOutcome.as_json`."""
    return CaseOutcome(**{**record, "reasons": tuple(record["reasons"])})


@dataclass(frozen=True)
class FaultStudy:
    """The work on each case of a matrix (a `bench.simulation.sweep.Study`)."""

    configuration: Configuration
    profile: Profile
    model_check: bool

    def prepared(self) -> Callable[[MatrixCase], CaseOutcome]:
        """Return the function that runs a case on a workbench of this process."""
        bench = Workbench(self.configuration, self.profile, model_check=self.model_check)
        return lambda case: bench.run(*case)


def fault_study(configuration: Configuration, profile: str, *, model_check: bool) -> FaultStudy:
    """Return the study of the profile named `profile`, with the limits of the model-based check that fit it.

    Raises:
        BenchError: there is no such profile.
    """
    path = find_profile(profile)
    swing = load_profile(path)
    envelope = configuration.envelope.with_model_check("always")
    return FaultStudy(replace(configuration, envelope=envelope).for_profile(swing, path), swing, model_check)


def matrix_store(path: Path, study: FaultStudy) -> OutcomeStore:
    """Return the store of a matrix in the file `path`."""
    digest = digest_of(study.configuration, study.profile, study.model_check)
    return SweepStore(path, digest, CaseOutcome.as_json, outcome_of)


def run_matrix(
    plan: MatrixPlan,
    study: FaultStudy,
    store: OutcomeStore,
    engine: Engine,
    *,
    progress: Callable[[int], None] = lambda done: None,
    stop: Callable[[], bool] = lambda: False,
) -> list[CaseOutcome]:
    """Run the cases that `store` lacks, and return the outcomes of all of `plan` in its order.

    `progress` is called with the number of cases done. On `stop` the outcomes so far are returned; the rest
    is run the next time.
    """
    return sweep(
        study,
        plan.cases,
        engine,
        store=store,
        key=lambda case: f"{case[0].name}, {case[1].name}",
        group=lambda case: case[1],  # a worker keeps the fault-free bench at an instant
        progress=progress,
        stop=stop,
    )
