"""A person who went in during ACCESS is not locked in: only the local reset and SECURE lock the guard."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bench.base.lifecycle import Cause, Refusal, Request, State
from tests.bench.control.operating import TIMES, asked, press, reach
from tests.bench.control.puppet import ATMOSPHERE, Puppet

FULL, EMPTY = (TIMES.vented_pressure + 1e5,) * 6, (ATMOSPHERE,) * 6
CAUSES: dict[str, tuple[Callable[[Puppet], Puppet], State]] = {
    "chambers": (lambda puppet: puppet.give(chamber_pressure=FULL), State.FAULT),
    "manifold": (lambda puppet: puppet.give(supply_pressure=5e5), State.FAULT),
    "supervisor": (lambda puppet: puppet.give(supervisor_alive=False), State.FAULT),
    "device": (lambda puppet: puppet.give(device_operational=False), State.FAULT),
    "emergency stop": (lambda puppet: puppet.give(emergency_stop_clear=False), State.ESTOP),
}
each_cause = pytest.mark.parametrize("name", CAUSES)


def released(puppet: Puppet) -> bool:
    return not puppet.record["guard_lock"][0]


def entered(name: str) -> Puppet:
    """Return a bench with a person inside who shut the guard, after the cause `name`."""
    puppet = reach(State.ACCESS, local_reset=True)
    puppet.give(guard_closed=False).run(10)
    puppet.give(guard_closed=True).run(10)
    change, state = CAUSES[name]
    change(puppet).run(5)
    assert puppet.bench is state
    return puppet


def clear(puppet: Puppet) -> None:
    """Let the cause be gone."""
    good = {"supervisor_alive": True, "device_operational": True, "emergency_stop_clear": True}
    puppet.give(chamber_pressure=EMPTY, supply_pressure=ATMOSPHERE, **good).run(30)


@each_cause
def test_guard_lock_cause_after_entry_stays_released(name: str) -> None:
    puppet = entered(name)
    assert released(puppet)
    clear(puppet)
    assert released(puppet)
    assert asked(puppet, Request.SECURE) is Refusal.LOCAL_RESET
    assert released(puppet)
    assert asked(puppet, Request.RESET) is Refusal.GUARD


@each_cause
def test_secure_after_press_locks_guard_and_keeps_cause(name: str) -> None:
    puppet = entered(name)
    clear(puppet)
    state = puppet.bench
    press(puppet)
    assert asked(puppet, Request.SECURE) is Refusal.NONE
    assert not released(puppet)
    puppet.give(guard_locked=True).run(5)
    assert puppet.bench is state
    assert not puppet.control["guard_was_opened"]
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET  # one press, one answer
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert not released(puppet)


@each_cause
def test_secure_guard_not_locking_releases_again(name: str) -> None:
    puppet = entered(name)
    clear(puppet)
    press(puppet)
    assert asked(puppet, Request.SECURE) is Refusal.NONE
    puppet.give(guard_closed=False).run(2100)
    puppet.give(guard_closed=True).run(10)
    assert released(puppet)


@each_cause
def test_guard_lock_cause_without_entry_locks(name: str) -> None:
    puppet = reach(State.ACCESS, local_reset=True)
    change, state = CAUSES[name]
    change(puppet).run(5)
    assert puppet.bench is state
    assert not released(puppet)
    assert asked(puppet, Request.SECURE) is Refusal.STATE


def test_secure_lock_failure_in_access_faults_and_releases_guard() -> None:
    puppet = reach(State.ACCESS, local_reset=True)
    puppet.give(guard_closed=False).run(10)
    puppet.give(guard_closed=True).run(10)
    press(puppet)
    assert asked(puppet, Request.SECURE) is Refusal.NONE
    puppet.run(2100)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.GUARD)
    assert released(puppet)
