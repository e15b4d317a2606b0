"""Each fault of the air, the lock or the robot's rest has its refusal, of each request that it bars."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bench.control.air_watch import SENSORS
from bench.control.requests import refusal_of
from bench.lifecycle import Refusal, Request, State
from tests.bench.control.operating import press, reach
from tests.bench.control.puppet import Puppet


def refused(puppet: Puppet, request: Request, **found: Any) -> Refusal:
    """Return why `request` is refused once the watches wrote `found` to the control's state."""
    for name, value in found.items():
        puppet.control[name] = value
    return Refusal(
        int(refusal_of(puppet.state, puppet.parameters, puppet.readings, request.value, puppet.time))
    )


def one_dead(sensor: int) -> list[int]:
    """Return which sensors are dead if only `sensor` is."""
    return [int(k == sensor) for k in range(SENSORS)]


FOUND = {
    "lock": ({"lock_wrong": True}, Refusal.LOCK),
    "sensor of the manifold": ({"sensor_dead": one_dead(0)}, Refusal.SENSOR),
    "sensor of a chamber": ({"sensor_dead": one_dead(4)}, Refusal.SENSOR),
    "first vent": ({"vent_wrong": [1, 0]}, Refusal.VENT),
    "second vent": ({"vent_wrong": [0, 1]}, Refusal.VENT),
    "shut-off valve": ({"shut_off_wrong": True}, Refusal.VENT),
    "supply valve": ({"supply_wrong": True}, Refusal.MANIFOLD),
}


@pytest.mark.parametrize("request_", [Request.RESET, Request.HOME, Request.ARM], ids=lambda r: r.name)
@pytest.mark.parametrize(("found", "expected"), FOUND.values(), ids=FOUND)
def test_what_fails_is_named(found: dict[str, Any], expected: Refusal, request_: Request) -> None:
    states = {Request.RESET: State.FAULT, Request.HOME: State.SAFE, Request.ARM: State.READY}
    puppet = reach(states[request_])
    press(puppet)
    assert refused(puppet, request_) is Refusal.NONE
    assert refused(puppet, request_, **found) is expected


def test_access_names_a_shut_off_valve_that_does_not_follow() -> None:
    """Behind it nothing proves that the manifold is empty."""
    puppet = reach(State.READY)
    assert refused(puppet, Request.ACCESS) is Refusal.NONE
    found = {"emptied": False, "vented": False, "shut_off_wrong": True}
    assert refused(puppet, Request.ACCESS, **found) is Refusal.VENT


@pytest.mark.parametrize(("source", "excused"), [(State.FAULT, True), (State.READY, False)])
def test_a_manifold_that_fell_too_fast_bars_all_but_the_reset(source: State, excused: bool) -> None:
    puppet = reach(source)
    press(puppet)
    request = Request.RESET if excused else Request.ARM
    expected = Refusal.NONE if excused else Refusal.SENSOR
    assert refused(puppet, request, supply_unproven=True, supply_excused=False) is expected


def test_a_joint_that_moved_a_moment_ago_bars_the_reset() -> None:
    puppet = reach(State.FAULT)
    press(puppet)
    assert refused(puppet, Request.RESET, moved_at=puppet.time) is Refusal.MOVING


def test_a_tee_waits_for_the_head_that_comes_back() -> None:
    puppet = reach(State.ARMED)
    assert refused(puppet, Request.TEE, moved_at=puppet.time) is Refusal.MOVING
    assert refused(puppet, Request.TEE, moved_at=-np.inf) is Refusal.NONE


@pytest.mark.parametrize("ready", [False, True])
def test_a_swing_with_planned_air_waits_for_it(ready: bool) -> None:
    puppet = reach(State.ARMED)
    puppet.parameters.profile["air_planned"] = True
    assert refused(puppet, Request.SWING, air_ready=ready) is (Refusal.NONE if ready else Refusal.AIR)


def test_access_waits_for_a_manifolds_sensor_that_proves_something() -> None:
    assert refused(reach(State.READY), Request.ACCESS, supply_unproven=True) is Refusal.SENSOR


def test_access_names_a_dead_sensor_instead_of_chambers_that_may_be_full() -> None:
    puppet = reach(State.READY)
    assert refused(puppet, Request.ACCESS, vented=False, sensor_dead=one_dead(2)) is Refusal.SENSOR


@pytest.mark.parametrize("entered", [False, True])
def test_a_latched_bench_locks_the_guard_only_after_somebody_went_in(entered: bool) -> None:
    puppet = reach(State.FAULT)
    press(puppet)
    assert refused(puppet, Request.SECURE, entered=entered) is (Refusal.NONE if entered else Refusal.STATE)
