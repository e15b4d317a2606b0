"""No access while any sensor shows pressure, and trapped pressure is reported."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Refusal, Request, State
from bench.control.settings import holding_pressure
from sim.plant import PlantParameters
from tests.bench.control.operating import TIMES, asked, at_power_up, full, lose, press, reach, until
from tests.bench.control.puppet import ATMOSPHERE, SUPPLY, Puppet

EMPTY_AT = TIMES.vented_pressure
HOLDING = holding_pressure(PlantParameters())
LATCHED = (State.ESTOP, State.FAULT)
FROM = (State.SAFE, State.READY, *LATCHED)
each_source = pytest.mark.parametrize("source", FROM, ids=lambda state: state.name)


def vent(puppet: Puppet) -> Puppet:
    """Fill the chambers of a robot at its address, and let sensors show them and the manifold fall empty."""
    puppet.give(chamber_pressure=(5.0e5,) * 6).run(20)
    puppet.tick(Request.DISARM)
    puppet.run(200)
    for bar in (4.5, 4.0, 3.5, 3.0, 2.5, 2.0, 1.5):
        puppet.give(chamber_pressure=(1e5 * bar,) * 6).run(10)
    return puppet.give(supply_pressure=ATMOSPHERE, chamber_pressure=(ATMOSPHERE,) * 6)


def stick_open(puppet: Puppet, pressure: float = SUPPLY) -> None:
    """Let the supply valve be stuck open: the manifold keeps `pressure` without a command."""
    puppet.give(supply_pressure=pressure, chamber_pressure=(ATMOSPHERE,) * 6)


def test_access_after_power_up_waits_for_access_delay() -> None:
    """Who restarted it a second after a stop may find the last air, and friction, still holding an arm."""
    puppet = at_power_up(rest_time_vented=0.05, access_delay=0.5)
    puppet.control["is_warmed_up"] = True
    assert until(puppet, *LATCHED) in LATCHED
    puppet.run(400)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(110)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


@each_source
def test_access_full_manifold_keeps_guard_locked(source: State) -> None:
    puppet = reach(source)
    stick_open(puppet)
    puppet.run(5)
    if source in LATCHED:
        assert asked(puppet, Request.ACCESS) is Refusal.MANIFOLD
    else:
        assert asked(puppet, Request.ACCESS) is not Refusal.NONE
    assert puppet.record["guard_lock"][0]
    assert not puppet.control["vented"]
    puppet.run(25)
    assert puppet.bench is (source if source in LATCHED else State.FAULT)
    assert puppet.cause is Cause.MANIFOLD


@pytest.mark.parametrize("pressure", [HOLDING + 1.0, EMPTY_AT + 1.0, SUPPLY, inf])
def test_access_manifold_above_holding_pressure_refused(pressure: float) -> None:
    puppet = reach(State.READY, vent_timeout=5.0)
    stick_open(puppet, pressure)
    puppet.tick()
    assert asked(puppet, Request.ACCESS) is Refusal.MANIFOLD
    puppet.give(supply_pressure=HOLDING).run(20)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_access_after_disarm_waits_for_manifold() -> None:
    puppet = reach(State.ARMED, vent_timeout=0.5, rest_time_vented=0.05)
    stick_open(puppet)
    puppet.tick(Request.DISARM)
    puppet.run(490)
    assert asked(puppet, Request.ACCESS) is Refusal.MANIFOLD
    puppet.run(20)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.MANIFOLD)
    assert asked(puppet, Request.ACCESS) is Refusal.MANIFOLD
    assert asked(puppet, Request.RESET) is Refusal.MANIFOLD
    puppet.give(supply_pressure=ATMOSPHERE).run(60)
    assert asked(puppet, Request.RESET) is Refusal.NONE


def test_manifold_filling_in_access_latches_fault() -> None:
    puppet = reach(State.ACCESS)
    puppet.run(5)
    puppet.give(supply_pressure=SUPPLY).tick()
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.MANIFOLD)


@pytest.mark.parametrize("source", LATCHED, ids=lambda state: state.name)
@pytest.mark.parametrize("cause", [Cause.NOT_VENTED, Cause.MANIFOLD], ids=lambda cause: cause.name)
def test_trapped_pressure_in_latched_state_replaces_cause(source: State, cause: Cause) -> None:
    puppet = reach(source)
    assert puppet.cause not in (Cause.NOT_VENTED, Cause.MANIFOLD)
    if cause is Cause.MANIFOLD:
        stick_open(puppet)
    else:
        full(puppet)
    puppet.run(40)
    assert (puppet.bench, puppet.cause) == (source, cause)
    puppet.give(supply_pressure=ATMOSPHERE, chamber_pressure=(ATMOSPHERE,) * 6).run(40)
    assert (puppet.bench, puppet.cause) == (source, cause)


def test_trapped_pressure_during_emergency_stop_reports_manifold_and_keeps_emergency() -> None:
    puppet = reach(State.ESTOP)
    puppet.give(emergency_stop_clear=False)
    stick_open(puppet)
    puppet.run(40)
    assert (puppet.bench, puppet.cause) == (State.ESTOP, Cause.MANIFOLD)
    assert puppet.control["emergency"]


def test_access_manifold_without_sensor_waits_for_vent_timeout() -> None:
    puppet = reach(State.ARMED, vent_timeout=0.3)
    puppet.give(supply_pressure=nan)
    puppet.control["sensors"]["seen"] = 0  # it never was there
    puppet.tick(Request.DISARM)
    puppet.run(290)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(20)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


@pytest.mark.parametrize("before", [True, False], ids=["before venting", "as it begins"])
def test_access_sensor_early_at_empty_waits_for_vent_timeout(before: bool) -> None:
    puppet = reach(State.ARMED, vent_timeout=5.0)
    full, stuck = (5.0e5,) * 6, (ATMOSPHERE, *(5.0e5,) * 5)
    puppet.give(chamber_pressure=stuck if before else full).run(20)
    puppet.tick(Request.DISARM)
    puppet.run(40)
    puppet.give(chamber_pressure=stuck).run(40)
    for bar in (4.5, 4.0, 3.5, 3.0, 2.5, 2.0, 1.5):
        puppet.give(chamber_pressure=(ATMOSPHERE, *(1e5 * bar,) * 5)).run(10)
    puppet.give(supply_pressure=ATMOSPHERE, chamber_pressure=(ATMOSPHERE,) * 6).run(4000)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(1000)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_access_at_power_up_waits_for_rest_time() -> None:
    puppet = reach(State.SAFE, rest_time_vented=2.0)
    puppet.control["venting"]["start"] = puppet.time
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(2100)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_access_encoders_at_rest_waits_for_access_delay() -> None:
    """A stuck encoder shows rest: only the time with empty chambers proves that a raised arm has sunk."""
    puppet = reach(State.ARMED, vent_timeout=0.5, rest_time_vented=0.05, access_delay=3.0)
    vent(puppet).run(2900)
    assert puppet.control["venting"]["emptied"]
    assert not puppet.control["vented"]
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(200)
    assert puppet.control["vented"]
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def emptied(creep: float) -> Puppet:
    """Return a robot that has vented for 3 s while its shoulder crept at `creep` rad/s."""
    puppet = reach(State.ARMED, vent_timeout=0.5, rest_time_vented=0.05, access_delay=2.0)
    vent(puppet)
    for _ in range(300):
        puppet.angle = puppet.angle + np.array([0.01 * creep, 0.0, 0.0])
        puppet.run(10)
    return puppet


@pytest.mark.parametrize(("creep", "let_in"), [(0.0, True), (0.0002, True), (0.002, False), (-0.002, False)])
def test_access_creeping_arm_refused(creep: float, let_in: bool) -> None:
    puppet = emptied(creep)
    assert bool(puppet.control["vented"]) is let_in
    assert asked(puppet, Request.ACCESS) is (Refusal.NONE if let_in else Refusal.NOT_VENTED)


def test_access_arm_at_rest_after_creep_accepted() -> None:
    puppet = emptied(0.002)
    puppet.run(2200)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_access_sensor_above_atmosphere_latches_exhaust() -> None:
    """A wrong zero looks like air that holds an arm up: only its chamber can be named."""
    puppet = reach(State.ARMED, vent_timeout=0.5, rest_time_vented=0.05)
    vent(puppet)
    puppet.give(chamber_pressure=(*(ATMOSPHERE,) * 5, 1.1e5)).run(5000)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    assert puppet.cause is Cause.WRIST_B_EXHAUST


@pytest.mark.parametrize("shown", [ATMOSPHERE, 5.0e5], ids=["stuck empty", "full"])
def test_access_delay_restarts_with_pressure(shown: float) -> None:
    puppet = reach(State.ARMED, vent_timeout=0.5, rest_time_vented=0.05, access_delay=3.0)
    puppet.give(chamber_pressure=(shown,) * 6).run(20)
    puppet.tick(Request.DISARM)
    puppet.run(400)
    puppet.give(supply_pressure=ATMOSPHERE, chamber_pressure=(ATMOSPHERE,) * 6).run(2500)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED


def test_access_observed_pressure_decay_accepted_before_vent_timeout() -> None:
    puppet = reach(State.ARMED, vent_timeout=5.0)
    vent(puppet).run(3000)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_access_after_trapped_air_with_button_requires_press() -> None:
    puppet = reach(State.ARMED, vent_timeout=0.5, rest_time_vented=0.05, local_reset=True)
    puppet.give(chamber_pressure=(5.0e5,) * 6).run(20)
    puppet.tick(Request.DISARM)
    puppet.run(600)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.NOT_VENTED)
    puppet.give(supply_pressure=ATMOSPHERE, chamber_pressure=(ATMOSPHERE,) * 6).run(1000)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert asked(puppet, Request.ACCESS) is Refusal.GAUGE  # the reset has used that press up
    press(puppet)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    assert not puppet.control["venting"]["trapped"]


def test_access_after_trapped_air_without_button_requires_venting() -> None:
    puppet = reach(State.READY)
    puppet.control["venting"]["trapped"] = True
    assert asked(puppet, Request.ACCESS) is Refusal.GAUGE
    assert asked(puppet, Request.ARM) is Refusal.NONE
    puppet.run(420)
    puppet.tick(Request.DISARM)
    puppet.run(100)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


@pytest.mark.parametrize("button", [True, False])
def test_access_chambers_without_sensors_requires_press(button: bool) -> None:
    puppet = reach(State.READY, fitted=False, local_reset=button)
    puppet.run(100)
    assert asked(puppet, Request.ACCESS) is Refusal.GAUGE
    press(puppet)
    assert asked(puppet, Request.ACCESS) is (Refusal.NONE if button else Refusal.GAUGE)


def test_access_press_before_first_request_is_refused_once() -> None:
    """The sender of the request learns so that a person has locked the supply to read the gauges."""
    puppet = reach(State.READY, fitted=False, local_reset=True)
    puppet.run(100)
    press(puppet)
    assert asked(puppet, Request.ACCESS) is Refusal.GAUGE
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    assert puppet.bench is State.ACCESS


def test_access_brief_pressure_after_venting_waits_access_delay_only() -> None:
    puppet = reach(State.READY, access_delay=0.5)
    puppet.run(2000)
    puppet.give(chamber_pressure=(HOLDING + 1.0,) * 6).run(10)
    puppet.give(chamber_pressure=(ATMOSPHERE,) * 6).run(400)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(150)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_access_slow_venting_waits_for_venting_time_again() -> None:
    """Behind a throttled exhaust the last air, which may hold an arm, goes as slowly as the first."""
    puppet = reach(State.ARMED, vent_timeout=5.0, rest_time_vented=0.05, access_delay=0.5)
    vent(puppet).give(chamber_pressure=(HOLDING + 1.0,) * 6)
    puppet.run(700)
    puppet.give(chamber_pressure=(ATMOSPHERE,) * 6).run(900)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.run(100)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_holding_pressure_equals_fifth_of_least_static_friction() -> None:
    plant = PlantParameters()
    least = min(a.friction.static / max(a.area_a, a.area_b) for a in plant.actuators)
    assert plant.supply.atmosphere + 0.2 * least == pytest.approx(HOLDING)
    smooth = replace(plant.shoulder, friction=replace(plant.shoulder.friction, coulomb=0.0, static=0.0))
    resolved = holding_pressure(replace(plant, shoulder=smooth)) - plant.supply.atmosphere
    assert 1e3 < resolved < HOLDING - plant.supply.atmosphere


@pytest.mark.parametrize("source", [State.FAULT, State.ACCESS])
def test_encoder_lost_at_rest_requires_homing(source: State) -> None:
    puppet = reach(source)
    assert puppet.control["homed"]
    lose(puppet, 0)
    puppet.run(50)
    puppet.readings["encoder_valid"][0, 0] = True
    puppet.run(300)
    assert not puppet.control["homed"]
