"""The local reset button: only a press after the stop, from outside, counts; SECURE locks no one in."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bench.base.lifecycle import Cause, Refusal, Request, State
from bench.control.settings import SIMULATED
from bench.loop.loop import Cycle
from bench.records.telemetry.cycle_record import CYCLE
from drivers.base import Command, DriverError, Readings
from drivers.base.compiled import new_record
from tests.bench.control.operating import TIMES, asked, press, reach
from tests.bench.control.puppet import ATMOSPHERE, Puppet

Act = Callable[[Puppet], None]


def dip(**values: bool) -> Act:
    """Return the act of changing inputs for three ticks."""

    def act(puppet: Puppet) -> None:
        puppet.give(**values).run(3)
        puppet.give(**{name: not value for name, value in values.items()}).run(3)

    return act


STOPS: dict[str, Act] = {
    "emergency stop": dip(emergency_stop_clear=False),
    "network stop": lambda puppet: puppet.step(Request.EMERGENCY_STOP),
    "guard opened": dip(guard_closed=False),
    "guard unlocked": dip(guard_locked=False),
    "supervisor dead": dip(supervisor_alive=False),
    "device passive": dip(device_operational=False),
}
each_stop = pytest.mark.parametrize("name", STOPS)


@each_stop
@pytest.mark.parametrize("source", [State.READY, State.ARMED], ids=lambda state: state.name)
def test_local_reset_press_before_stop_does_not_count(name: str, source: State) -> None:
    puppet = reach(source, local_reset=True)
    press(puppet)
    STOPS[name](puppet)
    puppet.run(200)
    assert puppet.bench in {State.ESTOP, State.FAULT}
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE


@pytest.mark.parametrize("name", ["emergency stop", "network stop", "guard opened", "guard unlocked"])
@pytest.mark.parametrize("state", [State.ESTOP, State.FAULT], ids=lambda state: state.name)
def test_local_reset_press_before_second_stop_does_not_count(name: str, state: State) -> None:
    puppet = reach(state, local_reset=True)
    press(puppet)
    STOPS[name](puppet)
    puppet.run(30)
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET


def test_local_reset_press_during_brake_does_not_count() -> None:
    puppet = reach(State.SWINGING, local_reset=True)
    puppet.give(emergency_stop_clear=False).run(3)
    puppet.give(emergency_stop_clear=True).run(3)
    press(puppet)
    puppet.run(2000)
    assert puppet.bench is State.ESTOP
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET


def stuck() -> Puppet:
    """Return a bench in FAULT whose button is stuck since before the stop."""
    puppet = reach(State.READY, local_reset=True)
    puppet.give(local_reset=True).run(10)
    puppet.give(supervisor_alive=False).run(3)
    puppet.give(supervisor_alive=True).run(10)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.SUPERVISOR)
    return puppet


@pytest.mark.parametrize("ticks", [1, 5, 100])
def test_local_reset_stuck_button_after_lost_link_does_not_count(ticks: int) -> None:
    """Inputs that do not arrive read False, as all without energy does."""
    puppet = stuck()
    silent = dict.fromkeys(("local_reset", "emergency_stop_clear", "guard_closed", "guard_locked"), False)
    puppet.give(**silent).run(ticks)
    puppet.give(**dict.fromkeys(silent, True)).run(5)
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET


@pytest.mark.parametrize("ticks", [1, 5, 100])
def test_local_reset_stuck_button_after_passive_device_does_not_count(ticks: int) -> None:
    puppet = stuck()
    puppet.give(local_reset=False, device_operational=False).run(ticks)
    puppet.give(local_reset=True, device_operational=True).run(5)
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET
    puppet.give(local_reset=False).run(2)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE


class Away:
    """A driver whose button is stuck and whose readings fail for some ticks."""

    operational = True

    def __init__(self, readings: Readings) -> None:
        self.readings, self.fails = readings, False

    def open(self) -> None: ...

    def read(self, time: float) -> Readings:
        if self.fails:
            raise DriverError("no answer")
        return self.readings._replace(time=time, encoder_time=(time,) * 3)

    def write(self, command: Command) -> Command:
        return command

    def make_passive(self) -> None: ...

    def close(self) -> None: ...


def test_local_reset_stuck_button_after_read_error_does_not_count() -> None:
    puppet = Puppet(lifecycle=SIMULATED)
    good = Readings(
        0.0, (0, 0, 0), (0.0,) * 3, (True,) * 3, (0.0,) * 3, True, True, True, 1e5, True, False, (1e5,) * 6
    )  # fmt: skip
    driver = Away(good)
    cycle = Cycle(driver, puppet.parameters, lambda _: None, name="away")
    before = float(cycle.state.control["reset_pressed"][0])
    for k in range(30):
        driver.fails = 10 <= k < 20
        cycle.run_tick(1.0 + 1e-3 * k)
    assert cycle.state.control["reset_pressed"][0] == before
    assert new_record(CYCLE).dtype == cycle.record.dtype


# Leaving ACCESS ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", [State.READY, State.ESTOP, State.FAULT], ids=lambda state: state.name)
def test_secure_with_button_requires_press(source: State) -> None:
    """A remote client cannot see who is inside."""
    puppet = reach(source, local_reset=True)
    press(puppet)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    puppet.give(guard_locked=False, guard_closed=False).run(5)
    press(puppet)
    puppet.give(guard_closed=True).run(5)
    assert asked(puppet, Request.SECURE) is Refusal.LOCAL_RESET
    assert not puppet.record["guard_lock"][0]
    press(puppet)
    assert asked(puppet, Request.SECURE) is Refusal.NONE
    puppet.give(guard_locked=True).run(3)
    assert puppet.bench is source
    if source is not State.READY:  # one press, one use
        assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET


def test_secure_without_button_accepts() -> None:
    puppet = reach(State.ACCESS)
    assert asked(puppet, Request.SECURE) is Refusal.NONE


def test_secure_press_before_access_refused() -> None:
    puppet = reach(State.READY, local_reset=True)
    press(puppet)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    puppet.give(guard_locked=False).run(5)
    assert asked(puppet, Request.SECURE) is Refusal.LOCAL_RESET


@pytest.mark.parametrize("bridged", [False, True])
def test_secure_open_door_without_press_answer_shows_bridged_switch(bridged: bool) -> None:
    """The daily test of the doors; ARM gives the same answer with a bridged switch."""
    puppet = reach(State.READY, local_reset=True)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    puppet.give(guard_locked=False, guard_closed=bridged).run(5)
    assert asked(puppet, Request.SECURE) is (Refusal.LOCAL_RESET if bridged else Refusal.GUARD)
    assert asked(puppet, Request.ARM) is Refusal.STATE


# A cause while a person is inside ---------------------------------------------------------------------

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
