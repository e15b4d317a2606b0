"""The guard's lock: feedback that does not follow the command is reported, and nothing moves behind it."""

from __future__ import annotations

import pytest

from bench.base.lifecycle import Cause, Refusal, Request, State
from bench.control.monitor.position_monitor import UNLOCKING
from tests.bench.control.operating import asked, press, reach
from tests.bench.control.puppet import Puppet

LATE = round(1000 * UNLOCKING) + 10


def released(*, locked: bool, **settings: bool) -> Puppet:
    """Return a bench in ACCESS whose lock reads `locked` from the release on."""
    puppet = reach(State.READY, **settings)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    return puppet.give(guard_locked=locked)


def test_guard_lock_monitor_released_guard_unopened_stays_in_access() -> None:
    puppet = released(locked=False)
    puppet.run(5 * LATE)
    assert (puppet.bench, puppet.cause, puppet.cycle["air_fault"][0]) == (State.ACCESS, Cause.NONE, 0)


def test_guard_lock_monitor_unlock_within_time_reports_no_cause() -> None:
    puppet = released(locked=True)
    puppet.run(LATE - 30)
    puppet.give(guard_locked=False).run(2 * LATE)
    assert (puppet.bench, puppet.cause) == (State.ACCESS, Cause.NONE)


def test_guard_lock_monitor_locked_while_released_latches_fault() -> None:
    puppet = released(locked=True)
    puppet.run(LATE)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.GUARD_LOCK)
    assert puppet.record["guard_lock"][0]
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.LOCK  # it agrees with the command now, and proves nothing


def test_guard_lock_monitor_fault_with_open_guard_keeps_guard_unlocked() -> None:
    puppet = released(locked=True, local_reset=True)
    puppet.give(guard_closed=False).run(LATE)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.GUARD_LOCK)
    puppet.give(guard_closed=True).run(LATE)
    assert not puppet.record["guard_lock"][0]
    press(puppet)
    assert asked(puppet, Request.SECURE) is Refusal.NONE
    puppet.run(5)
    assert puppet.record["guard_lock"][0]
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.LOCK
    puppet.give(guard_locked=False).run(3)  # the switch is mended, and was seen to change
    puppet.give(guard_locked=True).run(3)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE


def test_guard_lock_monitor_feedback_following_release_clears_fault() -> None:
    puppet = released(locked=True)
    puppet.run(LATE)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    puppet.run(100)
    puppet.give(guard_locked=False).run(2 * LATE)  # the bolt came loose
    assert (puppet.bench, puppet.cycle["air_fault"][0]) == (State.ACCESS, 0)


@pytest.mark.parametrize("state", [State.ESTOP, State.FAULT], ids=lambda state: state.name)
def test_guard_lock_monitor_locked_with_guard_open_reports_guard_lock(state: State) -> None:
    puppet = reach(state)
    cause = puppet.cause
    puppet.give(guard_closed=False, guard_locked=True).run(LATE)
    assert (puppet.bench, puppet.cause) == (state, cause)
    assert Cause(int(puppet.control["latest_cause"])) is Cause.GUARD_LOCK
    puppet.give(guard_closed=True).run(2)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.LOCK


def test_guard_lock_monitor_passive_device_keeps_lock_trusted() -> None:
    puppet = released(locked=False)
    puppet.give(guard_closed=False).run(10)
    puppet.give(guard_closed=True, guard_locked=True, device_operational=False).run(2 * LATE)
    assert puppet.cause is Cause.DEVICE_PASSIVE
    assert not puppet.control["lock"]["wrong"]
