"""Why a request is refused: one condition at a time, two at once, and at each bound; on records alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, product
from math import inf, nan
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import (
    ACCEPTED_IN,
    NEEDS_LEASE,
    Answer,
    Cause,
    Phase,
    Reaction,
    Refusal,
    Request,
    State,
    transition_table,
)
from bench.control.monitor.pressure_monitor import SENSORS
from bench.control.requests import (
    check_request,
    execute_request,
    handle_request,
    is_released,
    manifold_is_full,
    monitor_local_reset,
    note_local_reset,
)
from bench.control.states import near_address
from bench.control.step_records import ControlParameters, ControlState
from tests.bench.control.puppet import Puppet, put

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
STOPS = (Request.STOP, Request.EMERGENCY_STOP)
NOW = 64.0
"""s; exact in binary, as all bounds here."""
VENT_TIME, RESET_TIME, STILL_TIME = 2.0, 0.5, 2.0**-4
TOLERANCE, STILL = np.array([0.5, 0.25, 0.125]), np.array([1.0, 2.0, 4.0])


@dataclass
class Situation:
    """A bench as the answer finds it."""

    state: ControlState
    parameters: ControlParameters
    readings: Any

    def refusal(self, request: int) -> Refusal:
        return Refusal(check_request(self.state, self.parameters, self.readings, request, NOW))


@pytest.fixture(scope="module")
def template() -> Situation:
    puppet = Puppet()
    return Situation(puppet.state, puppet.parameters, puppet.readings)


@pytest.fixture
def good(template: Situation) -> Callable[[Request], Situation]:
    """Return a maker of situations in which a request's guard holds."""

    def make(request: Request) -> Situation:
        state = ControlState(*(record.copy() for record in template.state))
        parameters = ControlParameters(*(record.copy() for record in template.parameters))
        s, p, e = state.control, parameters.control, state.estimator
        s["state"] = FROM.get(request, State.SWINGING)
        s["phase"] = Phase.HOLD if s["state"][0] == State.ARMED else Phase.STANDING
        for name in ("lease_held", "support_ready", "supervisor_alive", "device_operational"):
            s[name] = True
        s["venting"]["emptied"] = s["vented"] = True
        s["sensors"]["seen"] = 1
        s["venting"]["start"] = 0.0
        p["vent_timeout"], p["local_reset_time"], p["home_by_index"] = VENT_TIME, RESET_TIME, False
        p["address_tolerance"], p["rest_speed"], p["rest_time"] = TOLERANCE, STILL, STILL_TIME
        parameters.angle[0] = 0.0
        e["angle"] = e["velocity"] = 0.0
        return Situation(state, parameters, template.readings.copy())

    return make


@dataclass(frozen=True)
class Condition:
    """Something that forbids some requests."""

    name: str
    refusal: Refusal
    forbids: frozenset[Request]
    where: str
    values: dict[str, Any]

    def apply(self, situation: Situation) -> None:
        record = {
            "control": situation.state.control,
            "parameters": situation.parameters.control,
            "profile": situation.parameters.profile,
            "readings": situation.readings,
            "estimator": situation.state.estimator,
        }[self.where]
        for name, value in self.values.items():
            put(record, name, value)


def one_dead(sensor: int) -> tuple[int, ...]:
    return tuple(int(k == sensor) for k in range(SENSORS))


def only(*requests: Request) -> frozenset[Request]:
    return frozenset(requests)


MOVES_OR_RESETS = only(Request.ARM, Request.SWING, Request.RESET, Request.HOME)
CONDITIONS = (
    Condition("read only", Refusal.READ_ONLY, frozenset(FROM), "parameters", {"read_only": True}),
    Condition("wrong state", Refusal.STATE, frozenset(FROM), "control", {"state": State.SWINGING}),
    Condition(
        "stopping",
        Refusal.STOPPING,
        frozenset(FROM),
        "control",
        {"reaction": Reaction.BRAKE, "phase": Phase.HOLD},
    ),
    Condition("no lease", Refusal.NO_LEASE, NEEDS_LEASE, "control", {"lease_held": False}),
    Condition(
        "passive device",
        Refusal.DEVICE,
        only(Request.ARM, Request.SWING, Request.HOME, Request.ACCESS),
        "control",
        {"device_operational": False},
    ),
    Condition(
        "emergency stop",
        Refusal.EMERGENCY_STOP,
        MOVES_OR_RESETS | only(Request.ACCESS),
        "readings",
        {"emergency_stop_clear": False},
    ),
    Condition("guard unlocked", Refusal.GUARD, MOVES_OR_RESETS, "readings", {"guard_locked": False}),
    Condition(
        "guard open",
        Refusal.GUARD,
        MOVES_OR_RESETS | only(Request.SECURE),
        "readings",
        {"guard_closed": False},
    ),
    Condition(
        "lock released, seen locked", Refusal.GUARD, MOVES_OR_RESETS, "control", {"guard_was_opened": True}
    ),
    Condition("readings", Refusal.READINGS, MOVES_OR_RESETS, "control", {"encoder_fault": Cause.ARM_ENCODER}),
    Condition("supervisor", Refusal.SUPERVISOR, MOVES_OR_RESETS, "control", {"supervisor_alive": False}),
    Condition("lock", Refusal.LOCK, MOVES_OR_RESETS, "control", {"lock.wrong": True}),
    Condition("spool", Refusal.VENT, MOVES_OR_RESETS, "control", {"spools.wrong": (0, 1, 0)}),
    Condition("manifold's sensor", Refusal.SENSOR, MOVES_OR_RESETS, "control", {"sensors.dead": one_dead(0)}),
    Condition("first vent", Refusal.VENT, MOVES_OR_RESETS, "control", {"vents.wrong": (1, 0)}),
    Condition("second vent", Refusal.VENT, MOVES_OR_RESETS, "control", {"vents.wrong": (0, 1)}),
    Condition("shut-off valve", Refusal.VENT, MOVES_OR_RESETS, "control", {"shut_off.wrong": True}),
    Condition("supply valve", Refusal.MANIFOLD, MOVES_OR_RESETS, "control", {"manifold.wrong": True}),
    Condition(
        "manifold that fell too fast",
        Refusal.SENSOR,
        only(Request.ARM, Request.SWING, Request.HOME, Request.ACCESS),
        "control",
        {"manifold.unproven": True},
    ),
    Condition(
        "stopped just now",
        Refusal.STOPPED,
        only(Request.ARM, Request.SWING, Request.HOME),
        "control",
        {"stopped_at": NOW - 1.0},
    ),
    Condition(
        "moving",
        Refusal.MOVING,
        only(Request.ARM, Request.RESET, Request.HOME, Request.TEE),
        "control",
        {"moved_at": NOW - 2.0**-5},
    ),
    Condition("air in a chamber", Refusal.NOT_VENTED, only(Request.ARM), "control", {"sensors.shown": 9e5}),
    Condition(
        "support", Refusal.SUPPORT, only(Request.ARM, Request.SWING), "control", {"support_ready": False}
    ),
    Condition("on the way", Refusal.NOT_AT_ADDRESS, only(Request.SWING), "control", {"phase": Phase.RETURN}),
    Condition("swinging", Refusal.NOT_AT_ADDRESS, only(Request.SWING), "control", {"swinging": True}),
    Condition("air not as planned", Refusal.AIR, only(Request.SWING), "profile", {"air_planned": True}),
    Condition(
        "off the address", Refusal.NOT_AT_ADDRESS, only(Request.SWING), "estimator", {"angle": (0, 0, 1.0)}
    ),
    Condition(
        "pressure",
        Refusal.NOT_VENTED,
        only(Request.ACCESS, Request.HOME, Request.RESET),
        "control",
        {"venting.emptied": False, "vented": False},
    ),
    Condition("arm may sink", Refusal.NOT_VENTED, only(Request.ACCESS), "control", {"vented": False}),
    Condition("trapped air", Refusal.GAUGE, only(Request.ACCESS), "control", {"venting.trapped": True}),
    Condition(
        "no sensor",
        Refusal.GAUGE,
        only(Request.ACCESS),
        "control",
        {"sensors.seen": (1, 1, 0, 1, 1, 1, 1)},
    ),
    Condition(
        "button",
        Refusal.LOCAL_RESET,
        only(Request.RESET, Request.SECURE),
        "parameters",
        {"local_reset": True},
    ),
)
"""Conditions that block requests, in the order of their report to the operator."""

Make = Callable[[Request], Situation]
each_request = pytest.mark.parametrize("request_", FROM, ids=lambda request: request.name)


@each_request
def test_check_request_without_condition_accepts(good: Make, request_: Request) -> None:
    assert good(request_).refusal(request_) is Refusal.NONE


@each_request
def test_check_request_each_condition_refuses_only_listed_requests(good: Make, request_: Request) -> None:
    for condition in CONDITIONS:
        situation = good(request_)
        condition.apply(situation)
        expected = condition.refusal if request_ in condition.forbids else Refusal.NONE
        assert situation.refusal(request_) is expected, condition.name


@each_request
def test_check_request_two_conditions_reports_first(good: Make, request_: Request) -> None:
    forbidding = [condition for condition in CONDITIONS if request_ in condition.forbids]
    for first, second in combinations(forbidding, 2):
        situation = good(request_)
        second.apply(situation)
        first.apply(situation)
        assert situation.refusal(request_) is first.refusal, (first.name, second.name)


@pytest.mark.parametrize("request_", STOPS, ids=lambda request: request.name)
def test_check_request_stop_accepts_under_all_conditions(good: Make, request_: Request) -> None:
    situation = good(request_)
    for condition in CONDITIONS:
        condition.apply(situation)
    assert situation.refusal(request_) is Refusal.NONE


@pytest.mark.parametrize("request_", [len(Request), 255])
def test_check_request_unknown_request_refuses(good: Make, request_: int) -> None:
    assert good(Request.ARM).refusal(request_) is Refusal.STATE


@pytest.mark.parametrize(
    ("values", "stopping"),
    [
        ({"reaction": Reaction.COMPLETE, "phase": Phase.HOLD}, False),
        ({"reaction": Reaction.VENT, "phase": Phase.STANDING}, False),
        ({"reaction": Reaction.BRAKE, "phase": Phase.HOMING}, True),
    ],
)
def test_check_request_reaction_in_motion_refuses_as_stopping(
    good: Make, values: dict[str, int], stopping: bool
) -> None:
    situation = good(Request.TEE)
    for name, value in values.items():
        put(situation.state.control, name, value)
    assert situation.refusal(Request.TEE) is (Refusal.STOPPING if stopping else Refusal.NONE)


@pytest.mark.parametrize("state", State, ids=lambda state: state.name)
def test_check_request_other_state_refuses_by_state(good: Make, state: State) -> None:
    for request in FROM:
        if state not in ACCEPTED_IN[request]:
            situation = good(request)
            situation.state.control["state"] = state
            assert situation.refusal(request) is Refusal.STATE, request


@pytest.mark.parametrize("sensor", range(1, SENSORS))
def test_check_request_dead_chamber_sensor_refuses_motion_and_access(good: Make, sensor: int) -> None:
    refusals = dict.fromkeys(sorted(MOVES_OR_RESETS), Refusal.SENSOR) | {Request.ACCESS: Refusal.GAUGE}
    for request, refusal in refusals.items():
        situation = good(request)
        situation.state.control["sensors"]["dead"] = one_dead(sensor)
        assert situation.refusal(request) is refusal


@pytest.mark.parametrize(
    ("found", "refusal"),
    [
        ({"shut_off.wrong": True}, Refusal.VENT),
        ({"sensors.dead": one_dead(0)}, Refusal.SENSOR),
        ({"sensors.dead": one_dead(2)}, Refusal.SENSOR),
        ({"vents.wrong": (1, 0)}, Refusal.NOT_VENTED),
        ({}, Refusal.NOT_VENTED),
    ],
)
def test_check_request_access_not_vented_names_reason(
    good: Make, found: dict[str, Any], refusal: Refusal
) -> None:
    situation = good(Request.ACCESS)
    for name, value in (found | {"vented": False}).items():
        put(situation.state.control, name, value)
    assert situation.refusal(Request.ACCESS) is refusal


def test_manifold_is_full_above_vented_pressure_returns_true(good: Make) -> None:
    situation = good(Request.ARM)
    bound = situation.parameters.control["vented_pressure"][0]
    for pressure, full in ((bound, False), (np.nextafter(bound, inf), True), (nan, False)):
        situation.readings["supply_pressure"] = pressure
        assert manifold_is_full(situation.parameters.control[0], situation.readings) is full


def test_check_request_access_above_holding_pressure_names_manifold(good: Make) -> None:
    situation = good(Request.ACCESS)
    situation.state.control["vented"] = False
    bound = situation.parameters.control["holding_pressure"][0]
    for pressure, refusal in ((bound, Refusal.NOT_VENTED), (np.nextafter(bound, inf), Refusal.MANIFOLD)):
        situation.readings["supply_pressure"] = pressure
        assert situation.refusal(Request.ACCESS) is refusal


@pytest.mark.parametrize(("since", "refusal"), [(4.0, Refusal.NONE), (4.0 - 2.0**-40, Refusal.NOT_VENTED)])
def test_check_request_access_within_rest_time_refuses(good: Make, since: float, refusal: Refusal) -> None:
    situation = good(Request.ACCESS)
    situation.parameters.control["rest_time_vented"] = 4.0
    situation.state.control["venting"]["start"] = NOW - since
    assert situation.refusal(Request.ACCESS) is refusal


@pytest.mark.parametrize(
    ("fitted", "pressed", "before", "since", "read"),
    [
        (True, NOW, Refusal.GAUGE, 600.0, True),
        (True, NOW, Refusal.GAUGE, 600.0 + 2.0**-20, False),
        (True, NOW, Refusal.NONE, 600.0, False),
        (True, -inf, Refusal.GAUGE, 600.0, False),
        (False, NOW, Refusal.GAUGE, 600.0, False),
    ],
)
def test_check_request_access_with_trapped_air_requires_press_soon_after_refusal(
    good: Make, fitted: bool, pressed: float, before: Refusal, since: float, read: bool
) -> None:
    situation = good(Request.ACCESS)
    s, situation.parameters.control["local_reset"] = situation.state.control, fitted
    s["venting"]["trapped"], s["reset_pressed"], s["refusal"] = True, pressed, before
    s["gauge_refused"] = NOW - since
    assert situation.refusal(Request.ACCESS) is (Refusal.NONE if read else Refusal.GAUGE)


@pytest.mark.parametrize(("since", "refusal"), [(1.5 - 2.0**-40, Refusal.STOPPED), (1.5, Refusal.NONE)])
def test_check_request_shortly_after_stop_refuses(good: Make, since: float, refusal: Refusal) -> None:
    situation = good(Request.ARM)
    situation.state.control["stopped_at"] = NOW - since
    assert situation.refusal(Request.ARM) is refusal


def test_check_request_swing_with_planned_air_ready_accepts(good: Make) -> None:
    situation = good(Request.SWING)
    situation.parameters.profile["air_planned"] = situation.state.control["address_air"]["ready"] = True
    assert situation.refusal(Request.SWING) is Refusal.NONE


@pytest.mark.parametrize("entered", [False, True])
def test_check_request_secure_in_fault_requires_opened_guard(good: Make, entered: bool) -> None:
    situation = good(Request.SECURE)
    situation.state.control["state"], situation.state.control["guard_was_opened"] = State.FAULT, entered
    assert situation.refusal(Request.SECURE) is (Refusal.NONE if entered else Refusal.STATE)


def test_check_request_access_with_open_guard_accepts(good: Make) -> None:
    situation = good(Request.ACCESS)
    situation.readings["guard_closed"] = situation.readings["guard_locked"] = False
    assert situation.refusal(Request.ACCESS) is Refusal.NONE


@pytest.mark.parametrize(
    ("since", "refusal"), [(STILL_TIME, Refusal.NONE), (STILL_TIME - 2.0**-40, Refusal.MOVING)]
)
def test_check_request_within_rest_time_refuses_as_moving(good: Make, since: float, refusal: Refusal) -> None:
    for request in (Request.RESET, Request.HOME, Request.ARM):
        situation = good(request)
        situation.state.control["moved_at"] = NOW - since
        assert situation.refusal(request) is refusal


def test_check_request_home_by_index_with_air_accepts(good: Make) -> None:
    situation = good(Request.HOME)
    situation.parameters.control["home_by_index"] = True
    situation.state.control["venting"]["emptied"] = False
    assert situation.refusal(Request.HOME) is Refusal.NONE


@pytest.mark.parametrize(
    ("since", "refusal"),
    [(VENT_TIME, Refusal.NOT_VENTED), (VENT_TIME - 2.0**-40, Refusal.NONE), (0.0, Refusal.NONE)],
)
def test_check_request_reset_with_air_after_vent_timeout_refuses(
    good: Make, since: float, refusal: Refusal
) -> None:
    situation = good(Request.RESET)
    situation.state.control["venting"]["emptied"], situation.state.control["venting"]["start"] = (
        False,
        NOW - since,
    )
    assert situation.refusal(Request.RESET) is refusal


@pytest.mark.parametrize(
    ("since", "counts"), [(0.0, True), (RESET_TIME, True), (RESET_TIME + 2.0**-40, False), (nan, False)]
)
def test_check_request_press_counts_until_local_reset_time(good: Make, since: float, counts: bool) -> None:
    situation = good(Request.RESET)
    situation.parameters.control["local_reset"] = True
    situation.state.control["reset_pressed"] = NOW - since
    assert situation.refusal(Request.RESET) is (Refusal.NONE if counts else Refusal.LOCAL_RESET)


@pytest.mark.parametrize("joint", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_near_address_within_tolerance_and_at_rest_returns_true(good: Make, joint: int, sign: float) -> None:
    for name, bound in (("angle", TOLERANCE[joint]), ("velocity", 2.0 * STILL[joint])):
        for value, near in ((bound, True), (np.nextafter(bound, inf), False), (nan, False), (inf, False)):
            situation = good(Request.SWING)
            situation.state.estimator[name][0, joint] = sign * value
            assert near_address(situation.parameters, situation.state.estimator) == near


@pytest.mark.parametrize("joint", range(3))
def test_near_address_compares_with_first_profile_row(good: Make, joint: int) -> None:
    situation = good(Request.SWING)
    situation.parameters.angle[0, joint] = situation.state.estimator["angle"][0, joint] = 1.0
    assert near_address(situation.parameters, situation.state.estimator)


# What is remembered -----------------------------------------------------------------------------------


def taken(situation: Situation, request: int, number: int) -> int:
    """Put `request` with its number to a tick; return the request to execute."""
    control = situation.state.control
    control["request"], control["request_number"] = request, number
    return handle_request(situation.state, situation.parameters, situation.readings, NOW)


def told(situation: Situation) -> tuple[int, Answer, Refusal, int, int]:
    """Return answered number, answer, refusal, handled request, and pending request."""
    s = situation.state.control[0]
    return (
        int(s["answered_number"]),
        Answer(int(s["answer"])),
        Refusal(int(s["refusal"])),
        int(s["handled_request"]),
        int(s["request"]),
    )


def test_handle_request_accepted_request_answers_once(good: Make) -> None:
    situation = good(Request.ARM)
    assert taken(situation, Request.ARM, 5) == Request.ARM
    answer = (5, Answer.ACCEPTED, Refusal.NONE, Request.ARM, Request.NONE)
    assert told(situation) == answer
    assert taken(situation, Request.NONE, 6) == Request.NONE
    assert told(situation) == (5, Answer.ACCEPTED, Refusal.NONE, Request.NONE, Request.NONE)


def test_handle_request_refused_request_answers_with_refusal(good: Make) -> None:
    situation = good(Request.ARM)
    assert taken(situation, Request.SWING, 5) == Request.NONE
    assert told(situation) == (5, Answer.REFUSED, Refusal.STATE, Request.SWING, Request.NONE)
    assert taken(situation, Request.ARM, 6) == Request.ARM
    assert told(situation) == (6, Answer.ACCEPTED, Refusal.NONE, Request.ARM, Request.NONE)


def test_handle_request_refused_for_gauges_is_accepted_after_press(good: Make) -> None:
    situation = good(Request.ACCESS)
    s, situation.parameters.control["local_reset"] = situation.state.control, True
    s["venting"]["trapped"], s["reset_pressed"] = True, NOW
    taken(situation, Request.SWING, 4)
    assert s["gauge_refused"][0] == -inf
    assert taken(situation, Request.ACCESS, 5) == Request.NONE
    assert told(situation) == (5, Answer.REFUSED, Refusal.GAUGE, Request.ACCESS, Request.NONE)
    assert taken(situation, Request.ACCESS, 6) == Request.ACCESS


@pytest.mark.parametrize("stop", STOPS, ids=lambda request: request.name)
def test_handle_request_stop_without_new_number_keeps_last_answer(good: Make, stop: Request) -> None:
    situation = good(Request.ARM)
    taken(situation, Request.SWING, 5)
    assert taken(situation, stop, 5) == stop
    assert told(situation) == (5, Answer.REFUSED, Refusal.STATE, stop, Request.NONE)
    assert taken(situation, stop, 6) == stop
    assert told(situation) == (6, Answer.ACCEPTED, Refusal.NONE, stop, Request.NONE)
    assert situation.state.control["stopped_at"] == NOW


def test_handle_request_stop_before_first_number_answers(good: Make) -> None:
    situation = good(Request.ARM)
    assert taken(situation, Request.STOP, 0) == Request.STOP
    assert told(situation) == (0, Answer.ACCEPTED, Refusal.NONE, Request.STOP, Request.NONE)


def test_handle_request_repeated_number_answers_again(good: Make) -> None:
    situation = good(Request.ARM)
    assert taken(situation, Request.SWING, 5) == Request.NONE
    assert taken(situation, Request.ARM, 5) == Request.ARM
    assert told(situation) == (5, Answer.ACCEPTED, Refusal.NONE, Request.ARM, Request.NONE)


def test_note_local_reset_counts_rising_edge_only(good: Make) -> None:
    s = good(Request.RESET).state.control[0]
    s["reset_was_low"], s["reset_pressed"] = False, -1.0
    for time, level, pressed in (
        (1.0, True, -1.0),
        (2.0, False, -1.0),
        (3.0, True, 3.0),
        (4.0, True, 3.0),
        (5.0, True, 3.0),
        (5.5, False, 3.0),
        (6.0, False, 3.0),
        (7.0, True, 7.0),
    ):
        note_local_reset(s, level, time)
        assert s["reset_pressed"] == pressed, time


def test_monitor_local_reset_low_level_counts_with_device_and_circuit(good: Make) -> None:
    situation = good(Request.RESET)
    s, r = situation.state.control[0], situation.readings
    for operational, clear, before in product((True, False), repeat=3):
        s["device_operational"], s["reset_was_low"], r["emergency_stop_clear"] = operational, before, clear
        monitor_local_reset(s, r, NOW)
        assert s["reset_was_low"] == (operational and clear)


@pytest.mark.parametrize(
    ("state", "opened", "counts"),
    [
        (State.FAULT, None, True),
        (State.ACCESS, None, True),
        (State.FAULT, "guard_locked", False),
        (State.ACCESS, "guard_locked", True),
        (State.ACCESS, "guard_closed", False),
        (State.FAULT, "guard_closed", False),
        (State.FAULT, "emergency_stop_clear", False),
    ],
)
def test_monitor_local_reset_open_interlock_voids_press(
    good: Make, state: State, opened: str | None, counts: bool
) -> None:
    situation = good(Request.RESET)
    s, r = situation.state.control[0], situation.readings
    s["state"], s["reset_was_low"], r["local_reset"] = state, True, True
    if opened:
        r[opened] = False
    monitor_local_reset(s, r, NOW)
    assert s["reset_pressed"] == (NOW if counts else -inf)


def test_is_released_in_access_or_opened_until_secured(good: Make) -> None:
    s = good(Request.SECURE).state.control[0]
    for state, opened, securing in product((State.ACCESS, State.FAULT), (True, False), (True, False)):
        s["state"], s["guard_was_opened"], s["securing"] = state, opened, securing
        assert is_released(s) is ((state is State.ACCESS or opened) and not securing)


def executed(situation: Situation, request: Request, state: State) -> Any:
    """Return the control record after `request` was carried out in `state`."""
    situation.state.control["state"] = state
    execute_request(situation.state, situation.parameters, int(request), NOW)
    return situation.state.control[0]


@pytest.mark.parametrize(("state", "later"), [(State.RECOVERING, True), (State.ARMED, False)])
def test_execute_request_disarm_during_return_waits_for_end(good: Make, state: State, later: bool) -> None:
    s = executed(good(Request.DISARM), Request.DISARM, state)
    assert s["disarming"] == later
    assert s["state"] == (State.RECOVERING if later else State.READY)


@pytest.mark.parametrize("homed", [True, False])
def test_execute_request_reset_clears_cause_and_stop(good: Make, homed: bool) -> None:
    situation = good(Request.RESET)
    for name in ("cause", "latest_cause", "reaction", "emergency", "exhausts.slow", "manifold.unproven"):
        put(situation.state.control, name, 1)
    situation.state.control["homed"] = homed
    situation.state.control["reset_pressed"] = situation.state.control["stopped_at"] = NOW
    s = executed(situation, Request.RESET, State.FAULT)
    assert s["state"] == (State.READY if homed else State.SAFE)
    assert (s["cause"], s["latest_cause"], s["reaction"]) == (Cause.NONE, Cause.NONE, Reaction.NONE)
    assert (s["emergency"], s["manifold"]["excused"], s["exhausts"]["slow"].any()) == (False, True, False)
    assert (s["reset_pressed"], s["stopped_at"]) == (-inf, -inf)


def test_execute_request_arm_moves_after_warning_and_precharge(good: Make) -> None:
    situation = good(Request.ARM)
    p = situation.parameters.control
    p["warning_time"], p["precharge_time"] = 4.0, 2.0
    situation.state.control["tee"] = situation.state.control["disarming"] = True
    situation.state.pid["integral"] = 1.0
    s = executed(situation, Request.ARM, State.READY)
    assert (s["state"], s["disarming"], s["tee"]) == (State.ARMED, False, False)
    assert (s["air_from"], s["moving"], s["move"]["start"]) == (NOW + 4.0, True, NOW + 6.0)
    assert not situation.state.pid["integral"].any()


def test_execute_request_swing_begins_profile(good: Make) -> None:
    situation = good(Request.SWING)
    situation.parameters.angle[0] = TOLERANCE
    put(situation.state.control, "swing.struck", True)
    put(situation.state.control, "swing.fastest_head", 40.0)
    s = executed(situation, Request.SWING, State.ARMED)
    assert (s["state"], s["swinging"], s["swings"]) == (State.SWINGING, True, 1)
    assert (s["swing"]["start"], s["swing"]["struck"], s["swing"]["fastest_head"]) == (NOW, False, 0.0)
    assert s["reference"].tolist() == TOLERANCE.tolist()


def test_execute_request_access_secure_and_tee_set_their_fields(good: Make) -> None:
    situation = good(Request.ACCESS)
    situation.state.control["securing"] = situation.state.control["venting"]["trapped"] = True
    s = executed(situation, Request.ACCESS, State.READY)
    assert (s["state"], s["securing"], s["venting"]["trapped"]) == (State.ACCESS, False, False)
    s = executed(situation, Request.SECURE, State.ACCESS)
    assert (s["securing"], s["state_since"], s["reset_pressed"]) == (True, NOW, -inf)
    assert executed(good(Request.TEE), Request.TEE, State.ARMED)["tee"]


@pytest.mark.parametrize("by_index", [False, True])
def test_execute_request_home_by_index_begins_search(good: Make, by_index: bool) -> None:
    situation = good(Request.HOME)
    situation.parameters.control["home_by_index"] = by_index
    s = executed(situation, Request.HOME, State.SAFE)
    assert (s["state"], s["homed"], s["homing"]["agreed_since"]) == (State.HOMING, False, NOW)
    assert (s["phase"] == Phase.HOMING) == by_index


@pytest.mark.parametrize(
    ("request_", "target"),
    [
        (Request.RESET, State.SAFE),
        (Request.HOME, State.HOMING),
        (Request.ARM, State.ARMED),
        (Request.SWING, State.SWINGING),
        (Request.ACCESS, State.ACCESS),
    ],
)
def test_execute_request_in_wrong_state_latches_exception(
    good: Make, request_: Request, target: State
) -> None:
    wrong = next(state for state in State if not transition_table()[state][target])
    s = executed(good(request_), request_, wrong)
    assert (s["latest_cause"], s["cause"]) == (Cause.EXCEPTION, Cause.EXCEPTION)
    assert (s["swinging"], s["moving"], s["tee"]) == (False, False, False)


def test_execute_request_stop_changes_nothing(good: Make) -> None:
    situation = good(Request.STOP)
    before = situation.state.control.copy()
    execute_request(situation.state, situation.parameters, int(Request.STOP), NOW)
    assert repr(situation.state.control.tolist()) == repr(before.tolist())
