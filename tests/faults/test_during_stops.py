"""A stop is monitored, too: what breaks during it gets its own reaction.

First comes the stop, then, in the middle of it, a valve or an encoder breaks.
"""

from __future__ import annotations

import numba
import numpy as np
import pytest

from bench.faults.case import Workbench
from bench.faults.instants import Instant, instants_of
from bench.lifecycle import Cause, Phase, Reaction, Request
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


def broken(joint: str, opening: float, after: float) -> Fault:
    return Fault(f"{joint} valve", f"{joint} valve", "stuck", opening, time=after)


# Unmonitored, these stops ended at 125 to 387 % of a rating.
VALVES = (
    ("backswing 10 %", "operator stop", broken("shoulder", 1.0, 0.1)),
    ("backswing 10 %", "emergency stop", broken("shoulder", 1.0, 0.06)),
    ("downswing 20 %", "guard opened", broken("shoulder", 1.0, 0.03)),
    ("committed 60 %", "guard opened", broken("shoulder", -1.0, 0.01)),
    ("committed 60 %", "emergency stop", broken("shoulder", -1.0, 0.03)),
    ("impact +0 ms", "emergency stop", broken("shoulder", -1.0, 0.03)),
    ("follow-through 10 %", "guard opened", broken("shoulder", -1.0, 0.01)),
)


@pytest.mark.parametrize(
    ("at", "stop", "fault"), VALVES, ids=[f"{at}-{stop}-{fault.value:+.0f}" for at, stop, fault in VALVES]
)
def test_a_valve_that_sticks_open_during_a_stop_loses_its_air(
    workbench: Workbench, profile: Profile, at: str, stop: str, fault: Fault
) -> None:
    bench = stopped(workbench, instant_of(profile, at), stop, fault)
    cut = np.flatnonzero(bench.record()["reaction"] == Reaction.PASSIVE)
    assert len(cut)
    assert cut[0] - round(fault.time / bench.period) <= 80
    assert not unsafe(bench)


@pytest.mark.parametrize("joint", ["shoulder", "arm", "wrist"])
def test_an_encoder_lost_while_braking_does_not_restart_the_blind_pattern(
    workbench: Workbench, profile: Profile, joint: str
) -> None:
    fault = Fault("encoder", f"{joint} encoder", "off", time=0.2)
    bench = stopped(workbench, instant_of(profile, "downswing 80 %"), "guard opened", fault)
    assert not unsafe(bench)
    assert bench.loads().stop_share < 0.5


@pytest.mark.parametrize("stop", STOPS)
def test_a_healthy_stop_is_not_escalated(workbench: Workbench, profile: Profile, stop: str) -> None:
    for instant in instants_of(profile):
        if instant.phase not in ("standing", "homing", "return"):
            bench = stopped(workbench, instant, stop, None)
            known = {Cause.OPERATOR_STOP, Cause.EMERGENCY_STOP, Cause.GUARD}
            assert Cause(int(bench.control["latest_cause"][0])) in known, instant
            reactions = set(bench.record()["reaction"].tolist())
            assert reactions <= {Reaction.COMPLETE, Reaction.BRAKE, Reaction.VENT}, instant
