"""The whole matrix: the plan of its cases, and their run as a sweep that may be interrupted."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zlib import crc32

from bench.config import Configuration
from bench.faults.case import Workbench
from bench.faults.catalogue import (
    ACCESS,
    INTO_A_STOP,
    START,
    Breakage,
    Instant,
    dense_instants,
    instants_of,
    irrelevant,
    stopped_instants,
)
from bench.faults.compound_faults import CATALOGUE
from bench.faults.verdict import CaseOutcome
from bench.simulation.sweep import Engine, SweepStore, code_digest, sweep
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.faults import sort_of

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
    text = json.dumps([code_digest(__name__), parts, model_check], sort_keys=True)
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
