"""A stop is monitored, too: what breaks during it gets its own reaction.

First comes the stop, then, in the middle of it, a valve or an encoder breaks.
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from bench.faults.case import Instant, Workbench, instants_of
from bench.lifecycle import Cause, Phase, Reaction, Request, State
from bench.simulation.engine import LockstepEngine
from bench.simulation.safety import RunEnd, SafetyLimits, dangers
from bench.swing.profile import Profile
from sim.faults import Fault, own_records

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="whole swings take minutes without compilation"
)

STOPS = ("operator stop", "emergency stop", "guard opened")
LONGEST, STILL = 14000, 1500
"""Ticks."""


def stopped(workbench: Workbench, instant: Instant, stop: str, fault: Fault | None) -> LockstepEngine:
    """Return the bench at rest after `stop` at `instant` and `fault`; its record begins at the stop."""
    bench = workbench.base(instant)
    bench.stepper.plant = own_records(bench.stepper.plant)
    bench.begin_tally()
    bench.begin_record()
    if fault is not None:
        bench.stepper.break_with((fault,), watchdog=workbench.configuration.driver.watchdog)
    if stop == "emergency stop":
        bench.plant_state["emergency_stop_clear"] = False
    elif stop == "guard opened":
        bench.plant_state["guard_closed"] = False
    bench.advance(1, Request.STOP if stop == "operator stop" else 0)
    for _ in range(LONGEST // 100):
        bench.advance(100)
        if bench.phase is Phase.STANDING and rested(bench) >= STILL:
            break
    return bench


def rested(bench: LockstepEngine) -> int:
    """Return for how many ticks all joints have rested."""
    moving = np.flatnonzero((np.abs(bench.record()["plant_velocity"]) > 0.2).any(axis=1))
    return len(bench.record()) - 1 - (int(moving[-1]) if len(moving) else -1)


def unsafe(bench: LockstepEngine) -> list[str]:
    return dangers(RunEnd(bench.loads(), rested=rested(bench) >= STILL), SafetyLimits())


def instant_of(profile: Profile, name: str) -> Instant:
    return next(instant for instant in instants_of(profile) if instant.name == name)
