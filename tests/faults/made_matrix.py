"""Rows and instants of the matrix by name, and outcomes of faults as a test wants them, without a swing."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle
from typing import Any

from bench.faults._verdict import CaseOutcome
from bench.faults.catalogue import CATALOGUE, START, Breakage, Instant, instants_of, stopped_instants
from bench.faults.summary import VERDICTS, summarise
from bench.swing.profile import Profile

BREAKAGE = {breakage.name: breakage for breakage in CATALOGUE}


def instant(profile: Profile, name: str) -> Instant:
    """Return the instant of the matrix called `name`, alone or during a stop."""
    known = (*instants_of(profile), *stopped_instants(profile))
    return next(instant for instant in known if instant.name == name)


ORIGIN = {
    "commit": "0123456789ab",
    "configuration": "c",
    "profile": "p",
    "sources": "s",
    "seed": 1,
    "time_utc": "2026-01-02T03:04:05+00:00",
}


def outcome(breakage: Breakage, at: Instant, verdict: str, **changes: object) -> CaseOutcome:
    reasons = ("wrist lower stop took 200 % of its rated energy",) if verdict == "unsafe" else ()
    made = CaseOutcome(
        breakage.name,
        breakage.fault.signal,
        breakage.fault.kind,
        breakage.family,
        at.phase,
        at.name,
        verdict,
        reasons,
        "GUARD" if verdict == "safe" else "",
        1,
        "BRAKE",
        1,
        0.5,
        "wrist lower stop",
        0.7,
        0.1,
        0.02,
        1.0,
        500,
        "told",
        "FAULT",
        "",
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def whole_matrix() -> dict[str, Any]:
    """Return the summary of a matrix of every fault at one instant, with all verdicts."""
    verdicts = cycle(VERDICTS[:0:-1])
    outcomes = [outcome(breakage, START[0], next(verdicts)) for breakage in CATALOGUE]
    return summarise(outcomes, [], model_check=True, profile="default", seconds=1.0, origin=ORIGIN)
