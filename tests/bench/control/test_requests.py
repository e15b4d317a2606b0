"""Every refusal has its reason and its cure; a request is accepted when its guard holds, and only then."""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np
import pytest

from bench.control.requests import near_address
from bench.control.settings import holding_pressure
from bench.lifecycle import (
    ACCEPTED_IN,
    NEEDS_LEASE,
    REFUSAL_TEXT,
    Answer,
    Cause,
    Reaction,
    Refusal,
    Request,
    State,
)
from sim.plant import PlantParameters
from tests.bench.control.operating import (
    CONTROL,
    TIMES,
    Act,
    asked,
    at_power_up,
    braking,
    give,
    lose,
    on_the_way,
    press,
    reach,
    until,
)
from tests.bench.control.puppet import ADDRESS, Puppet

# Refusals ---------------------------------------------------------------------------------------------

CLEARED = (Request.RESET, Request.HOME, Request.ARM, Request.SWING)
"""Requests that need interlocks, readings and supervisor."""
FROM = {
    Request.RESET: State.FAULT,
    Request.HOME: State.SAFE,
    Request.ARM: State.READY,
    Request.SWING: State.ARMED,
    Request.ACCESS: State.READY,
    Request.SECURE: State.ACCESS,
    Request.TEE: State.ARMED,
    Request.DISARM: State.ARMED,
}


def refused_after(request: Request, act: Act, **settings: Any) -> Refusal:
    """Return why `request` is refused once `act` has changed the inputs, in one and the same tick."""
    puppet = reach(FROM[request], **settings)
    act(puppet)
    return asked(puppet, request)


def test_every_refusal_has_a_text_of_its_own() -> None:
    assert set(REFUSAL_TEXT) == set(Refusal)
    assert len(set(REFUSAL_TEXT.values())) == len(Refusal)


@pytest.mark.parametrize("request_", FROM, ids=lambda request: request.name)
def test_each_request_is_accepted_when_its_guard_holds(request_: Request) -> None:
    puppet = reach(FROM[request_])
    assert asked(puppet, request_) is Refusal.NONE


@pytest.mark.parametrize("state", State, ids=lambda state: state.name)
def test_in_each_state_all_other_requests_are_refused_by_the_state(state: State) -> None:
    puppet = reach(state)
    for request in Request:
        if request and state not in ACCEPTED_IN[request]:
            assert asked(puppet, request) is Refusal.STATE, request
            assert puppet.bench is state
    assert asked(puppet, len(Request)) is asked(puppet, 255) is Refusal.STATE


@pytest.mark.parametrize("request_", CLEARED, ids=lambda request: request.name)
@pytest.mark.parametrize(
    ("values", "refusal"),
    [
        ({"emergency_stop_clear": False}, Refusal.EMERGENCY_STOP),
        ({"guard_closed": False}, Refusal.GUARD),
        ({"guard_locked": False}, Refusal.GUARD),
        ({"supervisor_alive": False}, Refusal.SUPERVISOR),
        ({"lease_held": False}, Refusal.NO_LEASE),
    ],
    ids=lambda values: next(iter(values)) if isinstance(values, dict) else None,
)
def test_what_moves_or_resets_needs_interlocks_supervisor_and_lease(
    request_: Request, values: dict[str, bool], refusal: Refusal
) -> None:
    assert refused_after(request_, give(**values)) is refusal


@pytest.mark.parametrize("request_", CLEARED, ids=lambda request: request.name)
@pytest.mark.parametrize("joint", range(3))
def test_what_moves_or_resets_needs_every_encoder(request_: Request, joint: int) -> None:
    puppet = reach(FROM[request_])
    lose(puppet, joint)
    assert asked(puppet, request_) is Refusal.READINGS


@pytest.mark.parametrize("request_", sorted(NEEDS_LEASE), ids=lambda request: request.name)
def test_nobody_without_the_lease(request_: Request) -> None:
    assert refused_after(request_, give(lease_held=False)) is Refusal.NO_LEASE


def test_ending_motion_needs_no_lease() -> None:
    assert refused_after(Request.DISARM, give(lease_held=False)) is Refusal.NONE
    for request in (Request.STOP, Request.EMERGENCY_STOP):
        puppet = reach(State.ARMED)
        puppet.control["lease_held"] = False
        assert asked(puppet, request) is Refusal.NONE


@pytest.mark.parametrize("request_", [Request.ARM, Request.SWING], ids=lambda request: request.name)
def test_nothing_is_armed_or_swung_without_a_record(request_: Request) -> None:
    assert refused_after(request_, give(support_ready=False)) is Refusal.SUPPORT


@pytest.mark.parametrize(
    "request_", [Request.HOME, Request.ARM, Request.SWING, Request.ACCESS], ids=lambda request: request.name
)
def test_a_device_that_went_passive_is_reset_first(request_: Request) -> None:
    assert refused_after(request_, give(device_operational=False)) is Refusal.DEVICE


def test_a_reset_is_the_cure_of_a_passive_device() -> None:
    puppet = reach(State.READY)
    puppet.give(device_operational=False).tick()
    assert puppet.cause is Cause.DEVICE_PASSIVE
    puppet.tick()
    puppet.control["device_operational"] = True  # as the loop opens it anew in the tick after the reset
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert puppet.bench is State.READY


@pytest.mark.parametrize("request_", [r for r in Request if r > 0], ids=lambda request: request.name)
def test_a_bench_that_only_observes_refuses_all_but_a_stop(request_: Request) -> None:
    puppet = Puppet(read_only=True)
    puppet.run(10)
    ends_motion = request_ in {Request.STOP, Request.EMERGENCY_STOP}
    assert asked(puppet, request_) is (Refusal.NONE if ends_motion else Refusal.READ_ONLY)
    puppet.run(50)
    assert puppet.is_without_energy()


@pytest.mark.parametrize("request_", [Request.DISARM, Request.TEE, Request.SWING], ids=lambda r: r.name)
def test_while_a_stop_is_under_way_nothing_else_begins(request_: Request) -> None:
    puppet = reach(State.ARMED) if request_ is not Request.DISARM else braking()
    if request_ is not Request.DISARM:
        puppet.tick(Request.STOP)
        assert puppet.reaction is Reaction.BRAKE
    assert asked(puppet, request_) is Refusal.STOPPING


@pytest.mark.parametrize("joint", range(3))
@pytest.mark.parametrize("share", [0.9, -0.9, 1.1, -1.1])
def test_a_swing_begins_at_the_address_only(joint: int, share: float) -> None:
    puppet = reach(State.ARMED)
    puppet.shift(joint, share * CONTROL.address_tolerance[joint])
    puppet.run(50)
    assert asked(puppet, Request.SWING) is (Refusal.NONE if abs(share) < 1 else Refusal.NOT_AT_ADDRESS)


@pytest.mark.parametrize("joint", range(3))
@pytest.mark.parametrize("share", [0.95, -0.95, 1.05, -1.05, nan])
def test_resting_at_the_address_is_bounded_angle_and_bounded_speed(joint: int, share: float) -> None:
    puppet = reach(State.ARMED)
    e, p = puppet.state.estimator, puppet.parameters
    for value, bound in (
        ("angle", CONTROL.address_tolerance),
        ("velocity", 2 * np.array(CONTROL.still_speed)),
    ):
        e["angle"], e["velocity"] = ADDRESS, 0.0
        e[value][0, joint] += share * bound[joint]
        assert near_address(p, e) == (abs(share) < 1)


def test_a_swing_begins_in_the_hold_only() -> None:
    puppet = on_the_way()
    assert asked(puppet, Request.SWING) is Refusal.NOT_AT_ADDRESS


# Pressure and access ----------------------------------------------------------------------------------

HOLDING = holding_pressure(PlantParameters())
"""Up to it chambers hold nothing up (Pa absolute)."""


def test_access_needs_the_proof_that_the_chambers_are_empty() -> None:
    puppet = reach(State.ARMED, vent_time=0.5)
    puppet.tick(Request.DISARM)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(510)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    assert not puppet.record["guard_lock"][0]


def test_access_waits_for_the_last_chamber() -> None:
    puppet = reach(State.READY, vent_time=0.5)
    empty, full = HOLDING - 1.0, HOLDING + 1.0
    puppet.give(chamber_pressure=(empty,) * 5 + (full,)).tick()
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.give(chamber_pressure=(empty,) * 6).run(2)  # for as long as it held an arm up
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_arming_waits_for_the_last_chamber() -> None:
    puppet = reach(State.ARMED, vent_time=0.5)
    puppet.tick(Request.DISARM)
    empty, full = TIMES.vented_pressure - 1.0, TIMES.vented_pressure + 1.0
    puppet.give(chamber_pressure=(empty,) * 5 + (full,)).run(100)
    assert puppet.bench is State.READY
    assert asked(puppet, Request.ARM) is Refusal.NOT_VENTED
    puppet.give(chamber_pressure=(empty,) * 6).tick()
    assert asked(puppet, Request.ARM) is Refusal.NONE


def test_access_waits_until_the_robot_has_rested_with_empty_chambers() -> None:
    puppet = reach(State.READY, vent_time=1.0, vented_still=0.05, local_reset=True)
    puppet.give(chamber_pressure=(TIMES.vented_pressure + 1.0,) * 6).tick()
    puppet.give(chamber_pressure=(HOLDING - 1.0,) * 6).run(42)
    press(puppet)  # air so late was trapped: a person reads the gauges
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(10)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_a_raised_arm_that_sinks_is_not_vented_yet() -> None:
    puppet = reach(State.READY, vented_still=0.05)
    puppet.give(chamber_pressure=(HOLDING - 1.0,) * 6).run(60)
    assert puppet.control["vented"]
    puppet.follows = False
    for _ in range(100):
        puppet.offset[0] -= 5e-4
        puppet.tick()
    assert not puppet.control["vented"]
    puppet.run(100)
    assert puppet.control["vented"]


@pytest.mark.parametrize("doubt", [{"distrusted": True}, {}])
def test_where_encoders_cannot_tell_it_waits_for_as_long_as_an_arm_may_sink(doubt: dict[str, bool]) -> None:
    puppet = reach(State.FAULT, vented_still=0.05, vented_blind=0.3, local_reset=True)
    puppet.give(chamber_pressure=(TIMES.vented_pressure + 1.0,) * 6, **doubt).tick()
    if not doubt:
        lose(puppet)
    puppet.give(chamber_pressure=(HOLDING - 1.0,) * 6).run(287)
    press(puppet)  # air so late was trapped: a person reads the gauges
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(20)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_a_reset_trusts_the_readings_again() -> None:
    puppet = reach(State.FAULT)
    puppet.give(distrusted=True)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert not puppet.control["distrusted"]


def test_pressure_in_the_chambers_while_the_guard_is_unlocked_locks_it() -> None:
    puppet = reach(State.ACCESS)
    puppet.give(chamber_pressure=(TIMES.vented_pressure + 1.0,) * 6).tick()
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.NOT_VENTED)
    assert puppet.record["guard_lock"][0]


def test_a_reset_waits_until_the_chambers_are_empty() -> None:
    puppet = reach(State.READY)
    puppet.give(chamber_pressure=(2e5,) * 6).tick()
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.NOT_VENTED)
    assert asked(puppet, Request.RESET) is Refusal.NOT_VENTED
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.NOT_VENTED)
    puppet.give(chamber_pressure=(1e5,) * 6).tick()
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert puppet.bench is State.READY


def test_a_reset_need_not_wait_while_the_chambers_are_emptying() -> None:
    puppet = reach(State.ARMED, vent_time=0.5)
    puppet.tick(Request.STOP)
    assert until(puppet, State.FAULT) is State.FAULT
    puppet.give(chamber_pressure=(5e5,) * 6).tick()
    assert asked(puppet, Request.RESET) is Refusal.NONE
    puppet.run(400)
    assert puppet.bench is State.READY
    puppet.run(100)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.NOT_VENTED)


def test_an_open_emergency_stop_circuit_gives_no_access() -> None:
    puppet = reach(State.ESTOP)
    puppet.give(emergency_stop_clear=False).tick()
    assert asked(puppet, Request.ACCESS) is Refusal.EMERGENCY_STOP


@pytest.mark.parametrize("fitted", [True, False])
def test_homing_by_the_vented_pose_needs_empty_chambers(fitted: bool) -> None:
    """A sensor in each chamber proves them empty, or the time for venting."""
    puppet = reach(State.SAFE, fitted=fitted, vent_time=0.5)
    shown = TIMES.vented_pressure + 1.0 if fitted else nan
    puppet.give(vent_start=puppet.time, chamber_pressure=(shown,) * 6).tick()
    assert asked(puppet, Request.HOME) is Refusal.NOT_VENTED
    if fitted:
        puppet.give(chamber_pressure=(TIMES.vented_pressure - 1.0,) * 6).tick()
    else:
        puppet.run(510)
    assert asked(puppet, Request.HOME) is Refusal.NONE


def test_the_guard_is_locked_only_when_it_is_closed() -> None:
    puppet = reach(State.ACCESS)
    puppet.give(guard_closed=False).tick()
    assert asked(puppet, Request.SECURE) is Refusal.GUARD
    assert not puppet.record["guard_lock"][0]


# The button beside the robot --------------------------------------------------------------------------


@pytest.mark.parametrize("state", [State.ESTOP, State.FAULT], ids=lambda state: state.name)
def test_a_reset_takes_the_button_when_there_is_one(state: State) -> None:
    puppet = reach(state, local_reset=True)
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE


def test_a_button_that_is_held_since_the_start_is_no_press() -> None:
    puppet = at_power_up(local_reset=True)
    puppet.readings["local_reset"], puppet.control["warm"] = True, True
    puppet.run(30)
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET
    puppet.give(local_reset=False).tick()
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET
    puppet.give(local_reset=True).tick()
    assert asked(puppet, Request.RESET) is Refusal.NONE


def test_a_press_counts_for_its_time_and_for_one_reset() -> None:
    puppet = reach(State.FAULT, local_reset=True, local_reset_time=0.05)
    press(puppet)
    puppet.run(60)
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    puppet.give(supervisor_alive=False).tick()
    puppet.give(supervisor_alive=True).tick()
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET


# Answers ----------------------------------------------------------------------------------------------


def test_no_request_no_answer() -> None:
    puppet = reach(State.READY)
    assert puppet.tick() == Answer.NONE
    assert puppet.cycle["request"][0] == Request.NONE


def test_a_stop_does_not_overwrite_the_answer_to_a_numbered_request() -> None:
    puppet = reach(State.READY)
    tick = puppet.cycle
    puppet.give(request_number=7)
    assert asked(puppet, Request.SWING) is Refusal.STATE
    for stop in (Request.STOP, Request.EMERGENCY_STOP):
        puppet.step(stop)
        assert tick["request"][0] == stop
        assert (tick["request_number"][0], tick["answer"][0]) == (7, Answer.REFUSED)
        assert tick["refusal"][0] == Refusal.STATE
    assert puppet.bench is State.ESTOP
    puppet.control["request_number"] = 8  # a stop that comes with a number is answered under it
    assert asked(puppet, Request.STOP) is Refusal.NONE
    assert tick["request_number"][0] == 8
