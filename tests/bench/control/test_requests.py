"""The step's response to requests over time; refusals at an instant: `test_answers.py`."""

from __future__ import annotations

from math import nan, pi

import pytest

from bench.base.lifecycle import REFUSAL_TEXT, Answer, Cause, Refusal, Request, State
from bench.control.settings import holding_pressure
from sim.plant import PlantParameters
from tests.bench.control.operating import TIMES, asked, at_power_up, lose, press, reach, timed, until
from tests.bench.control.puppet import ATMOSPHERE, COUNTS, Puppet


def test_refusal_text_covers_each_refusal_uniquely() -> None:
    assert set(REFUSAL_TEXT) == set(Refusal)
    assert len(set(REFUSAL_TEXT.values())) == len(Refusal)


def test_reset_reopened_passive_device_returns_to_ready() -> None:
    puppet = reach(State.READY)
    puppet.give(device_operational=False).tick()
    assert puppet.cause is Cause.DEVICE_PASSIVE
    puppet.tick()
    puppet.control["device_operational"] = True  # as the loop opens it anew in the tick after the reset
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert puppet.bench is State.READY


@pytest.mark.parametrize(
    ("request_", "answer"), [(Request.ARM, Refusal.READ_ONLY), (Request.STOP, Refusal.NONE)]
)
def test_read_only_bench_stays_without_energy(request_: Request, answer: Refusal) -> None:
    puppet = Puppet(read_only=True)
    puppet.run(10)
    assert asked(puppet, request_) is answer
    puppet.run(50)
    assert puppet.is_without_energy()


# Pressure and access ----------------------------------------------------------------------------------

HOLDING = holding_pressure(PlantParameters())
"""Up to it chambers hold nothing up (Pa absolute)."""


def test_access_before_vent_timeout_refused() -> None:
    puppet = timed(reach(State.ARMED), vent_timeout=0.1)
    puppet.tick(Request.DISARM)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(110)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    assert not puppet.record["guard_lock"][0]


def test_access_last_chamber_above_holding_pressure_refused() -> None:
    puppet = timed(reach(State.READY), vent_timeout=0.1)
    empty, full = HOLDING - 1.0, HOLDING + 1.0
    puppet.give(chamber_pressure=(empty,) * 5 + (full,)).tick()
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.give(chamber_pressure=(empty,) * 6).run(2)  # for as long as it held an arm up
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_arm_last_chamber_not_vented_refused() -> None:
    puppet = timed(reach(State.ARMED), vent_timeout=0.1)
    puppet.tick(Request.DISARM)
    empty, full = TIMES.vented_pressure - 1.0, TIMES.vented_pressure + 1.0
    puppet.give(chamber_pressure=(empty,) * 5 + (full,)).run(50)
    assert puppet.bench is State.READY
    assert asked(puppet, Request.ARM) is Refusal.NOT_VENTED
    puppet.give(chamber_pressure=(empty,) * 6).tick()
    assert asked(puppet, Request.ARM) is Refusal.NONE


def test_access_empty_chambers_waits_for_rest_time() -> None:
    puppet = reach(State.READY, vent_timeout=1.0, rest_time_vented=0.05, local_reset=True)
    puppet.give(chamber_pressure=(TIMES.vented_pressure + 1.0,) * 6).tick()
    puppet.give(chamber_pressure=(HOLDING - 1.0,) * 6).run(42)
    press(puppet)  # air so late was trapped: a person reads the gauges
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(10)
    assert asked(puppet, Request.ACCESS) is Refusal.GAUGE  # the press preceded it
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_vented_sinking_arm_clears_until_rest() -> None:
    puppet = reach(State.READY, rest_time_vented=0.05)
    puppet.give(chamber_pressure=(HOLDING - 1.0,) * 6).run(60)
    assert puppet.control["vented"]
    puppet.follows = False
    for _ in range(100):
        puppet.offset[0] -= 5e-4
        puppet.tick()
    assert not puppet.control["vented"]
    puppet.run(100)
    assert puppet.control["vented"]


@pytest.mark.parametrize("doubt", [{"encoders_suspect": True}, {}])
def test_access_encoders_in_doubt_waits_for_longer_rest_time(doubt: dict[str, bool]) -> None:
    puppet = reach(State.FAULT, rest_time_vented=0.05, rest_time_without_encoders=0.3, local_reset=True)
    puppet.give(chamber_pressure=(TIMES.vented_pressure + 1.0,) * 6, **doubt).tick()
    if not doubt:
        lose(puppet)
    puppet.give(chamber_pressure=(HOLDING - 1.0,) * 6).run(287)
    press(puppet)  # air so late was trapped: a person reads the gauges
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(20)
    assert asked(puppet, Request.ACCESS) is Refusal.GAUGE  # the press preceded it
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_reset_clears_encoders_suspect() -> None:
    puppet = reach(State.FAULT)
    puppet.give(encoders_suspect=True)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert not puppet.control["encoders_suspect"]


def test_reset_with_chamber_pressure_refused() -> None:
    puppet = reach(State.READY)
    puppet.give(chamber_pressure=(2e5,) * 6).tick()
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.NOT_VENTED)
    assert asked(puppet, Request.RESET) is Refusal.NOT_VENTED
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.NOT_VENTED)
    puppet.give(chamber_pressure=(1e5,) * 6).tick()
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert puppet.bench is State.READY


def test_reset_before_vent_timeout_accepts_and_faults_later() -> None:
    puppet = timed(reach(State.ARMED), vent_timeout=0.1)
    puppet.tick(Request.STOP)
    assert until(puppet, State.FAULT) is State.FAULT
    puppet.give(chamber_pressure=(5e5,) * 6).tick()
    assert asked(puppet, Request.RESET) is Refusal.NONE
    puppet.run(70)
    assert puppet.bench is State.READY
    puppet.run(30)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.NOT_VENTED)


@pytest.mark.parametrize("fitted", [True, False])
def test_home_by_vented_pose_requires_empty_chambers(fitted: bool) -> None:
    """A sensor in each chamber proves them empty, or the time for venting."""
    puppet = reach(State.SAFE, fitted=fitted, vent_timeout=0.1)
    shown = TIMES.vented_pressure + 1.0 if fitted else nan
    puppet.give(**{"venting.start": puppet.time}, chamber_pressure=(shown,) * 6).tick()
    assert asked(puppet, Request.HOME) is Refusal.NOT_VENTED
    if fitted:
        puppet.give(chamber_pressure=(TIMES.vented_pressure - 1.0,) * 6).tick()
    else:
        puppet.run(110)
    assert asked(puppet, Request.HOME) is Refusal.NONE


def test_reset_keeps_encoders_suspect_until_vented() -> None:
    puppet = timed(
        reach(State.ARMED), vent_timeout=0.3, rest_time_vented=0.05, rest_time_without_encoders=0.1
    )
    puppet.give(chamber_pressure=(6e5,) * 6)
    puppet.give(encoder_valid=(0, 1, 1)).run(30)
    puppet.give(encoder_valid=1)
    assert until(puppet, State.FAULT) is State.FAULT
    puppet.run(150)
    assert puppet.control["encoders_suspect"]
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    for bar in (5.5, 5.0, 4.5, 4.0, 3.5, 3.0, 2.5, 2.0, 1.5):
        puppet.give(chamber_pressure=(1e5 * bar,) * 6).run(1)
    puppet.give(chamber_pressure=(ATMOSPHERE,) * 6).run(50)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    assert puppet.control["encoders_suspect"]
    puppet.run(55)
    assert not puppet.control["encoders_suspect"]
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED  # the venting took longer
    puppet.run(200)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_arm_after_reset_ignores_recent_stop() -> None:
    puppet = reach(State.ARMED)
    puppet.step(Request.STOP)
    puppet.run(200)
    assert puppet.bench is State.FAULT
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert asked(puppet, Request.ARM) is Refusal.NONE


# Rest -------------------------------------------------------------------------------------------------

STILL_CASES = (
    (State.FAULT, Request.RESET),
    (State.ESTOP, Request.RESET),
    (State.READY, Request.ARM),
    (State.READY, Request.HOME),
)
each_case = pytest.mark.parametrize(
    ("state", "request_"), STILL_CASES, ids=[f"{s.name}-{request.name}" for s, request in STILL_CASES]
)


def turn(puppet: Puppet, joint: int, speed: float, ticks: int) -> None:
    """Turn `joint` of the standing robot at `speed` (rad/s)."""
    for _ in range(ticks):
        puppet.angle[joint] += speed * puppet.period
        puppet.tick()


@each_case
@pytest.mark.parametrize("joint", range(3))
def test_request_moving_joint_refused(state: State, request_: Request, joint: int) -> None:
    puppet = reach(state)
    turn(puppet, joint, 0.5, 100)
    press(puppet)
    assert asked(puppet, request_) is Refusal.MOVING
    assert puppet.bench is state
    turn(puppet, joint, 0.5, 20)
    puppet.run(20)  # slow, as where a pendulum turns round
    press(puppet)
    assert asked(puppet, request_) is Refusal.MOVING
    puppet.run(100)
    press(puppet)
    assert asked(puppet, request_) is Refusal.NONE


@each_case
def test_request_flickering_count_accepted(state: State, request_: Request) -> None:
    puppet = reach(state)
    at = puppet.angle.copy()
    for k in range(200):
        puppet.angle = at + (k % 2) * 2 * pi / COUNTS
        puppet.tick()
    press(puppet)
    assert asked(puppet, request_) is Refusal.NONE


# The button beside the robot --------------------------------------------------------------------------


def test_local_reset_button_held_since_start_does_not_count() -> None:
    puppet = at_power_up(local_reset=True)
    puppet.readings["local_reset"], puppet.control["is_warmed_up"] = True, True
    puppet.run(30)
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET
    puppet.give(local_reset=False).tick()
    assert asked(puppet, Request.RESET) is Refusal.LOCAL_RESET
    puppet.give(local_reset=True).tick()
    assert asked(puppet, Request.RESET) is Refusal.NONE


def test_local_reset_press_expires_and_counts_once() -> None:
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


def test_cycle_stop_keeps_answer_to_numbered_request() -> None:
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
