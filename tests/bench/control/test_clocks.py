"""A clock that gives no number, jumps or runs backwards is a fault in its tick, and no more after a reset."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase, Reaction, Refusal, Request, State
from tests.bench.control.operating import asked, press, reach
from tests.bench.control.puppet import Puppet

each_wrong = pytest.mark.parametrize("wrong", [nan, inf, -inf])


def state_of(puppet: Puppet) -> State:
    """Return the bench's state as it is now, which mypy takes for unchanged after a first assertion."""
    return puppet.bench


def tell(puppet: Puppet, time: float) -> None:
    """Run one tick at `time` on the clock; the one after it is where it would be without."""
    true = puppet.time
    puppet.time = time - puppet.period
    puppet.tick()
    puppet.time = true + puppet.period


def is_well(puppet: Puppet) -> bool:
    e = puppet.state.estimator[0]
    finite = np.isfinite([*e["angle"], *e["velocity"], *e["acceleration"], *e["covariance"].ravel()]).all()
    return bool(finite and np.abs(e["angle"] - puppet.angle).max() < 2e-3)


def reset(puppet: Puppet) -> Refusal:
    press(puppet)
    return asked(puppet, Request.RESET)


@each_wrong
def test_clock_invalid_time_at_rest_faults_and_resets(wrong: float) -> None:
    puppet = reach(State.READY)
    tell(puppet, wrong)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.TICK_GAP)
    puppet.run(50)
    assert is_well(puppet)
    assert reset(puppet) is Refusal.NONE
    puppet.run(50)
    assert puppet.bench is State.READY
    assert asked(puppet, Request.ARM) is Refusal.NONE
    puppet.run(420)
    assert (puppet.bench, puppet.phase) == (State.ARMED, Phase.HOLD)


@each_wrong
@pytest.mark.parametrize("source", [State.ARMED, State.SWINGING], ids=lambda state: state.name)
def test_clock_invalid_time_in_motion_turns_passive_and_resets(wrong: float, source: State) -> None:
    puppet = reach(source)
    tell(puppet, wrong)
    assert (puppet.reaction, puppet.cause) == (Reaction.PASSIVE, Cause.TICK_GAP)
    assert puppet.is_without_energy() or not puppet.record["supply_enable"][0]
    puppet.run(2000)
    assert puppet.bench is State.FAULT
    assert reset(puppet) is Refusal.NONE
    assert state_of(puppet) is State.READY


@each_wrong
def test_cycle_invalid_time_keeps_values_finite(wrong: float) -> None:
    puppet = reach(State.READY)
    for _ in range(3):
        tell(puppet, wrong)
        for name in ("time", "measured_step", "angle", "velocity", "angle_variance", "head_position"):
            assert np.isfinite(puppet.cycle[name]).all(), name


@each_wrong
@pytest.mark.parametrize("state", [State.STARTING, State.ESTOP, State.FAULT], ids=lambda state: state.name)
def test_clock_invalid_time_in_latched_state_allows_reset(wrong: float, state: State) -> None:
    puppet = reach(state)
    tell(puppet, wrong)
    puppet.give(is_warmed_up=True).run(60)
    assert is_well(puppet)
    assert reset(puppet) is Refusal.NONE


@pytest.mark.parametrize(
    ("jump", "lasting"),
    [(-0.5, False), (-50.0, False), (1e300, False), (-1e300, False), (3600.0, False)]
    + [(-5.0, True), (-3600.0, True), (3600.0, True)],
)
def test_clock_jump_keeps_estimator_valid(jump: float, lasting: bool) -> None:
    puppet = reach(State.READY)
    if lasting:
        puppet.time += jump
    else:
        tell(puppet, puppet.time + jump)
    puppet.run(300)
    assert puppet.bench is State.FAULT or lasting
    assert is_well(puppet)
    if puppet.bench is State.FAULT:
        assert reset(puppet) is Refusal.NONE
    puppet.run(20)
    assert state_of(puppet) is State.READY


@pytest.mark.parametrize("name", ["angle", "velocity", "acceleration", "covariance"])
def test_estimator_nan_estimate_restarts_at_rest(name: str) -> None:
    puppet = reach(State.FAULT)
    puppet.state.estimator[name][0, 1] = nan
    puppet.run(50)
    assert is_well(puppet)
    assert reset(puppet) is Refusal.NONE
