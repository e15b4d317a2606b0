"""The supply manifold at each venting: it empties within its time, or is reported."""

from __future__ import annotations

from typing import Any

import pytest

from bench.base.lifecycle import Cause, Refusal, Request, State
from bench.control.monitor.venting_monitor import (
    LATE,
    MANIFOLD_MARGIN,
    PROOF_TIME,
    SHUTTING,
    monitor_manifold,
)
from bench.control.step_records import CONTROL_PARAMETERS, CONTROL_STATE
from drivers.base.compiled import new_record
from drivers.base.records import READINGS
from sim.plant import PlantParameters, build_plant
from tests.bench.control.operating import asked, press, reach
from tests.bench.control.puppet import ATMOSPHERE, SUPPLY, Puppet

PLANT = build_plant(PlantParameters()).plant
NAMED = round(1000 * (SHUTTING + LATE)) + 30


class Manifold:
    """The monitor of a manifold whose sensor readings the test sets."""

    def __init__(self) -> None:
        """Stand under pressure."""
        self.control, self.readings = new_record(CONTROL_STATE), new_record(READINGS)
        self.limits = new_record(CONTROL_PARAMETERS)
        self.limits["vented_pressure"], self.limits["highest_pressure"] = 1.3e5, 2e6
        self.control["device_operational"] = True
        self.control["tick"], self.shown = 10, SUPPLY
        for _ in range(3):
            self.tick(SUPPLY, powered=True)

    def tick(self, shown: float, *, powered: bool = False, step: float = 1e-3) -> None:
        self.shown = shown
        self.readings["supply_pressure"] = shown
        monitor_manifold(self.control[0], self.limits[0], PLANT[0], self.readings, powered, step)

    def fall(self, constant: float, seconds: float, end: float = ATMOSPHERE) -> Manifold:
        """Shut the supply; let the sensor fall to `end` (Pa) with a time constant of `constant` s."""
        for _ in range(round(1000 * seconds)):
            self.tick(self.shown + (end - self.shown) * 1e-3 / max(constant, 1e-3))
        return self

    @property
    def found(self) -> tuple[bool, bool]:
        """Whether it empties too slowly, and whether it fell too fast."""
        return bool(self.control["manifold"]["wrong"][0]), bool(self.control["manifold"]["unproven"][0])


@pytest.mark.parametrize("constant", [0.02, 0.04, 0.08, 0.15])
def test_manifold_monitor_plausible_decay_rate_passes(constant: float) -> None:
    manifold = Manifold()
    for _ in range(3000):
        manifold.fall(constant, 1e-3)
        assert manifold.found == (False, False)


@pytest.mark.parametrize("end", [SUPPLY, 4e5, 2e5])
def test_manifold_monitor_pressure_kept_reports_wrong_within_second(end: float) -> None:
    assert Manifold().fall(0.04, 1.0, end).found == (True, False)


def test_manifold_monitor_slow_sensor_reports_wrong() -> None:
    manifold = Manifold()
    named = False
    for _ in range(1500):
        manifold.fall(0.5, 1e-3)
        named = named or manifold.found[0]
    assert named


@pytest.mark.parametrize("end", [ATMOSPHERE, 1.2e5, 0.5e5])
def test_manifold_monitor_decay_faster_than_plant_stays_unproven(end: float) -> None:
    manifold = Manifold().fall(0.0, 0.03, end)
    assert manifold.found[1]
    manifold.fall(0.0, 3.0, ATMOSPHERE)
    assert manifold.found == (False, True)


def test_manifold_monitor_plausible_venting_proves_sensor_again() -> None:
    manifold = Manifold().fall(0.0, 3.0)
    for _ in range(3):
        manifold.tick(SUPPLY, powered=True)
    manifold.fall(0.04, PROOF_TIME - 0.1)
    assert manifold.found == (False, True)
    assert manifold.fall(0.04, 0.2).found == (False, False)


def test_manifold_monitor_venting_of_empty_manifold_stays_unproven() -> None:
    manifold = Manifold().fall(0.0, 3.0)
    manifold.tick(1.5e5, powered=True)
    assert manifold.fall(0.04, 3.0).found == (False, True)


def test_manifold_monitor_loop_stall_ignores_fast_decay() -> None:
    manifold = Manifold()
    manifold.tick(SUPPLY)
    manifold.tick(ATMOSPHERE, step=0.5)
    assert manifold.fall(0.0, 3.0).found == (False, False)


@pytest.mark.parametrize("at", [0, 50, 200, 350, 1000])
def test_manifold_monitor_jump_to_empty_reports_unproven(at: int) -> None:
    manifold = Manifold()
    for _ in range(at):
        manifold.tick(SUPPLY)  # the supply valve is stuck open
    assert manifold.fall(0.0, 0.03).found[1]


def test_manifold_monitor_jump_with_supply_on_reports_unproven() -> None:
    manifold = Manifold()
    for _ in range(30):
        manifold.tick(ATMOSPHERE, powered=True)
    assert manifold.found == (False, True)


def test_manifold_monitor_single_high_readings_reports_nothing() -> None:
    manifold = Manifold()
    for tick in range(200):
        manifold.tick(1.2e6 if tick % 50 == 49 else SUPPLY, powered=True)
    assert manifold.found == (False, False)


def test_manifold_monitor_inputs_after_lost_link_reports_nothing() -> None:
    manifold = Manifold()
    manifold.control["encoder_fault"] = 4
    for _ in range(50):
        manifold.tick(SUPPLY)
    manifold.tick(ATMOSPHERE)
    manifold.control["encoder_fault"] = 0
    assert manifold.fall(0.0, 0.5).found == (False, False)


def test_manifold_monitor_noise_and_rare_samples_reports_nothing() -> None:
    manifold, held = Manifold(), SUPPLY
    true = SUPPLY
    for tick in range(3000):
        true += (ATMOSPHERE - true) * 1e-3 / 0.04
        if tick % 20 == 0:
            held = true + (0.3 * MANIFOLD_MARGIN if tick % 40 else -0.3 * MANIFOLD_MARGIN)
        manifold.tick(held)
        assert manifold.found == (False, False)


def disarmed(**settings: Any) -> Puppet:
    puppet = reach(State.ARMED, **settings)
    puppet.run(50)
    assert puppet.tick(Request.DISARM)
    return puppet


def test_manifold_monitor_stuck_supply_valve_latches_fault_at_venting() -> None:
    puppet = disarmed(vent_timeout=5.0)
    puppet.give(supply_pressure=SUPPLY).run(NAMED)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.SUPPLY_VALVE)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.MANIFOLD
    puppet.give(supply_pressure=ATMOSPHERE).run(200)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE


def test_access_supply_decay_refused_until_venting_proves_sensor() -> None:
    puppet = reach(State.ARMED)
    puppet.parameters.plant["manifold"] = PLANT["manifold"]  # as large as the assumed one
    puppet.run(50)
    puppet.give(supply_pressure=SUPPLY).tick(Request.DISARM)
    puppet.give(supply_pressure=ATMOSPHERE).run(30)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.SUPPLY_DECAY)
    puppet.run(500)
    assert asked(puppet, Request.ACCESS) is Refusal.SENSOR
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE  # to arm and vent again is its proof
    puppet.run(500)
    assert puppet.bench is State.READY
    assert asked(puppet, Request.ACCESS) is Refusal.SENSOR
    puppet.give(supply_pressure=SUPPLY)
    assert asked(puppet, Request.ARM) is Refusal.NONE
    puppet.run(450)
    assert puppet.tick(Request.DISARM)
    pressure = SUPPLY
    for _ in range(round(1000 * PROOF_TIME) + 10):
        pressure += (ATMOSPHERE - pressure) / 40.0
        puppet.give(supply_pressure=pressure).tick()
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_chamber_sensor_below_atmosphere_at_rest_reports_dead() -> None:
    puppet = reach(State.READY, vent_timeout=0.3)
    puppet.give(chamber_pressure=(ATMOSPHERE,) * 6).run(400)
    puppet.give(chamber_pressure=(ATMOSPHERE, ATMOSPHERE, 0.7 * ATMOSPHERE, *(ATMOSPHERE,) * 3)).run(150)
    assert puppet.cause is Cause.ARM_A_SENSOR


def test_supply_sensor_below_atmosphere_at_rest_reports_supply_decay() -> None:
    puppet = reach(State.READY, vent_timeout=0.3)
    puppet.run(400)
    puppet.give(supply_pressure=0.7 * ATMOSPHERE).run(150)
    assert puppet.cause is Cause.SUPPLY_DECAY
    assert asked(puppet, Request.ACCESS) is Refusal.SENSOR
