"""A failed sensor or vent is reported, blocks arming, and no longer counts as evidence."""

from __future__ import annotations

from math import inf, nan

import pytest

from bench.base.lifecycle import READINGS_VALID, Cause, Reaction, Refusal, Request, State
from bench.control._motion_monitor import table_column
from bench.control.monitor.pressure_monitor import DEAD_AFTER, SWITCHING
from tests.bench.control.operating import asked, press, reach, until
from tests.bench.control.puppet import ATMOSPHERE, SUPPLY, Puppet
from tests.sampling import release_except

DEAD_TICKS = round(DEAD_AFTER * 1000) + 20
CHAMBERS = 6
SENSORS = [Cause(cause) for cause in range(Cause.SUPPLY_SENSOR, Cause.VENT_1)]
STANDING = (State.SAFE, State.READY)
each_sensor = pytest.mark.parametrize("sensor", SENSORS, ids=lambda cause: cause.name)
some_sensors = pytest.mark.parametrize(
    "sensor",
    release_except({Cause.SUPPLY_SENSOR, Cause.SHOULDER_A_SENSOR, Cause.WRIST_B_SENSOR}, SENSORS),
    ids=lambda cause: cause.name,
)
no_value = pytest.mark.parametrize("value", [inf, nan, 0.0, -1e5, 1e9])


def fit(puppet: Puppet, *, vents: bool = False) -> Puppet:
    """Fit sensors to the empty chambers, and feedback to the open vents."""
    puppet.give(chamber_pressure=(ATMOSPHERE,) * CHAMBERS)
    if vents:
        puppet.give(vent_open=(1.0, 1.0))
    puppet.run(3)
    return puppet


def kill(puppet: Puppet, sensor: Cause, value: float = inf) -> None:
    """Let `sensor` show `value` from now on."""
    if sensor is Cause.SUPPLY_SENSOR:
        puppet.give(supply_pressure=value)
    else:
        puppet.readings["chamber_pressure"][0, sensor - Cause.SHOULDER_A_SENSOR] = value


def revive(puppet: Puppet) -> None:
    """Let all sensors show empty chambers again, for long enough to be believed."""
    puppet.give(supply_pressure=ATMOSPHERE, chamber_pressure=(ATMOSPHERE,) * CHAMBERS)
    puppet.run(500)


@each_sensor
@pytest.mark.parametrize("source", STANDING, ids=lambda state: state.name)
def test_pressure_monitor_dead_sensor_latches_fault_by_place(sensor: Cause, source: State) -> None:
    puppet = fit(reach(source))
    kill(puppet, sensor)
    puppet.run(DEAD_TICKS)
    assert (puppet.bench, puppet.cause) == (State.FAULT, sensor)
    assert puppet.cycle["air_fault"][0] == 1 << (sensor - Cause.SUPPLY_SENSOR)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.SENSOR
    revive(puppet)
    assert puppet.cycle["air_fault"][0] == 0
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE


@no_value
def test_pressure_monitor_impossible_value_reports_dead_sensor(value: float) -> None:
    puppet = fit(reach(State.READY))
    kill(puppet, Cause.ARM_B_SENSOR, value)
    puppet.run(DEAD_TICKS)
    assert puppet.cause is Cause.ARM_B_SENSOR


@some_sensors
def test_pressure_monitor_fitted_sensor_never_seen_refuses_reset(sensor: Cause) -> None:
    puppet = reach(State.ESTOP, homed=False)
    puppet.control["sensors"]["seen"] = 0
    kill(puppet, sensor)
    puppet.run(DEAD_TICKS)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.SENSOR
    assert puppet.cycle["air_fault"][0] == 1 << (sensor - Cause.SUPPLY_SENSOR)


def test_pressure_monitor_chamber_without_sensor_reports_nothing() -> None:
    puppet = reach(State.READY, fitted=False)
    puppet.run(DEAD_TICKS)
    assert (puppet.bench, puppet.cycle["air_fault"][0]) == (State.READY, 0)


@some_sensors
def test_pressure_monitor_lost_frames_reports_nothing(sensor: Cause) -> None:
    puppet = fit(reach(State.READY))
    for _ in range(20):
        kill(puppet, sensor)
        puppet.run(10)
        revive(puppet)
    assert (puppet.bench, puppet.cause) == (State.READY, Cause.NONE)


def test_pressure_monitor_frequent_dropouts_reports_dead_sensor() -> None:
    puppet = fit(reach(State.READY))
    for tick in range(1500):
        kill(puppet, Cause.WRIST_A_SENSOR, inf if tick % 10 < 3 else ATMOSPHERE)
        puppet.tick()
    assert puppet.cause is Cause.WRIST_A_SENSOR


@some_sensors
def test_access_dead_sensor_refused_after_any_wait(sensor: Cause) -> None:
    puppet = fit(reach(State.READY))
    kill(puppet, sensor)
    puppet.tick()
    assert asked(puppet, Request.ACCESS) is not Refusal.NONE  # in doubt already
    puppet.run(5000)
    assert asked(puppet, Request.ACCESS) is Refusal.SENSOR
    assert puppet.record["guard_lock"][0]


@some_sensors
def test_access_dead_chamber_sensor_accepts_vent_time_and_press(
    sensor: Cause,
) -> None:
    puppet = fit(reach(State.READY, rest_time_without_encoders=0.5, local_reset=True), vents=True)
    puppet.control["venting"]["start"] = puppet.time
    kill(puppet, sensor)
    puppet.run(400)
    assert asked(puppet, Request.ACCESS) is Refusal.SENSOR
    puppet.run(200)
    manifold = sensor is Cause.SUPPLY_SENSOR  # which the vents do not empty
    assert asked(puppet, Request.ACCESS) is (Refusal.SENSOR if manifold else Refusal.GAUGE)
    press(puppet)
    assert asked(puppet, Request.ACCESS) is (Refusal.SENSOR if manifold else Refusal.NONE)


def test_access_dead_sensor_with_shut_vents_refused() -> None:
    puppet = fit(reach(State.READY, rest_time_without_encoders=0.5), vents=True)
    puppet.give(vent_open=(0.0, 0.0))
    kill(puppet, Cause.ARM_A_SENSOR)
    puppet.run(5000)
    assert asked(puppet, Request.ACCESS) is Refusal.SENSOR


def test_access_low_pressure_with_both_vents_shut_refused() -> None:
    """The air left below `vented_pressure` carries an arm, which sinks as it leaks away."""
    puppet = fit(reach(State.READY), vents=True)
    puppet.give(vent_open=(0.0, 0.0)).run(20)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.give(vent_open=(0.0, 1.0)).run(20)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_access_without_chamber_sensors_requires_open_vent() -> None:
    puppet = reach(State.ARMED, fitted=False, vent_timeout=0.3)
    puppet.give(vent_open=(0.0, 0.0)).tick(Request.DISARM)
    puppet.run(400)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    puppet.give(vent_open=(0.0, 1.0)).run(2)
    assert puppet.control["vented"]


def test_pressure_monitor_sensor_lost_in_access_faults_after_secure() -> None:
    puppet = fit(reach(State.READY, rest_time_without_encoders=0.1), vents=True)
    puppet.run(200)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    puppet.give(guard_locked=False)
    kill(puppet, Cause.SHOULDER_B_SENSOR)
    puppet.run(1000)
    assert (puppet.bench, puppet.cause) == (State.ACCESS, Cause.NONE)
    press(puppet)
    assert asked(puppet, Request.SECURE) is Refusal.NONE
    puppet.give(guard_locked=True).run(10)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.SHOULDER_B_SENSOR)


@pytest.mark.parametrize(
    "sensor", [Cause.SUPPLY_SENSOR, Cause.SHOULDER_B_SENSOR], ids=lambda cause: cause.name
)
def test_pressure_monitor_dead_sensor_in_unproven_access_faults(sensor: Cause) -> None:
    puppet = fit(reach(State.ACCESS))
    kill(puppet, sensor)
    puppet.run(DEAD_TICKS)
    assert (puppet.bench, puppet.cause) == (State.FAULT, sensor)


@some_sensors
def test_pressure_monitor_dead_sensor_while_armed_brakes(sensor: Cause) -> None:
    puppet = reach(State.ARMED)
    puppet.give(chamber_pressure=(SUPPLY,) * CHAMBERS).run(3)
    kill(puppet, sensor)
    for _ in range(DEAD_TICKS):
        if puppet.cause is Cause.NONE:
            puppet.tick()
    assert puppet.cause is sensor
    assert puppet.reaction is Reaction.BRAKE
    assert not puppet.control["encoders_suspect"]  # joints and encoders are not in doubt
    puppet.give(supply_pressure=ATMOSPHERE, chamber_pressure=(ATMOSPHERE,) * CHAMBERS)
    kill(puppet, sensor)
    assert until(puppet, State.FAULT) is State.FAULT


def test_table_column_pressure_causes_use_valid_readings() -> None:
    for cause in (Cause.MANIFOLD, *SENSORS, Cause.VENT_1, Cause.VENT_2, Cause.SHUT_OFF):
        assert table_column(cause) == READINGS_VALID


# Vents -----------------------------------------------------------------------------------------------


def vented(puppet: Puppet) -> Puppet:
    """Let the vents' feedback follow the command."""
    shut = bool(puppet.record["exhaust_closed"][0])
    return puppet.give(vent_open=(0.0, 0.0) if shut else (1.0, 1.0))


@pytest.mark.parametrize("vent", [0, 1])
def test_vent_stuck_shut_faults_at_venting(vent: int) -> None:
    puppet = reach(State.ARMED)
    vented(puppet).run(300)
    assert puppet.bench is State.ARMED
    positions = [1.0, 1.0]
    positions[vent] = 0.0
    puppet.tick(Request.DISARM)
    puppet.give(vent_open=positions).run(600)
    delay = float(puppet.parameters.control["vent_delay"][0])
    puppet.run(round(1000 * (SWITCHING + delay)))
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.VENT_1 + vent)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.VENT
    assert asked(puppet, Request.ACCESS) is Refusal.NONE  # the other one vents
    puppet.give(vent_open=(1.0, 1.0), guard_locked=False).run(5)


@pytest.mark.parametrize("vent", [0, 1])
def test_vent_stuck_open_faults_before_motion(vent: int) -> None:
    puppet = reach(State.READY)
    puppet.parameters.control["precharge_time"] = 2.0
    vented(puppet).run(1000)
    assert asked(puppet, Request.ARM) is Refusal.NONE
    positions = [0.0, 0.0]
    positions[vent] = 1.0
    puppet.give(vent_open=positions).run(round(1000 * SWITCHING) + 20)
    assert puppet.cause == Cause.VENT_1 + vent
    assert not puppet.control["swinging"]
    assert until(puppet, State.FAULT) is State.FAULT


def test_vents_released_by_emergency_stop_report_nothing() -> None:
    puppet = reach(State.ARMED)
    vented(puppet).run(100)
    puppet.give(vent_open=(1.0, 1.0), emergency_stop_clear=False).run(3000)
    assert puppet.cycle["air_fault"][0] == 0


def test_shut_off_valve_stuck_open_faults_and_refuses_access() -> None:
    puppet = reach(State.ARMED, vent_timeout=0.05)
    puppet.give(shut_off_open=1.0).run(300)
    assert puppet.bench is State.ARMED
    puppet.tick(Request.DISARM)
    puppet.run(round(1000 * (SWITCHING + float(puppet.parameters.control["shut_off_delay"][0]))) - 10)
    assert (puppet.bench, puppet.cycle["air_fault"][0]) == (State.READY, 0)
    puppet.run(20)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.SHUT_OFF)
    assert asked(puppet, Request.ACCESS) is Refusal.VENT
    assert puppet.record["guard_lock"][0]
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.VENT
    puppet.give(shut_off_open=0.0).run(50)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_shut_off_valve_opening_in_access_faults() -> None:
    puppet = reach(State.READY, vent_timeout=0.05)
    puppet.give(shut_off_open=0.0).run(100)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    puppet.give(shut_off_open=1.0, guard_locked=False).run(
        round(1000 * (SWITCHING + float(puppet.parameters.control["shut_off_delay"][0]))) + 10
    )
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.SHUT_OFF)


def test_shut_off_valve_stuck_shut_faults_before_motion() -> None:
    puppet = reach(State.READY)
    puppet.parameters.control["precharge_time"] = 2.0
    puppet.give(shut_off_open=0.0).run(1000)
    assert asked(puppet, Request.ARM) is Refusal.NONE
    puppet.run(round(1000 * SWITCHING) + 20)
    assert puppet.cause is Cause.SHUT_OFF
    assert until(puppet, State.FAULT) is State.FAULT


def test_vent_lost_feedback_reports_cause() -> None:
    puppet = fit(reach(State.READY), vents=True)
    puppet.give(vent_open=(1.0, inf)).run(2000)
    assert puppet.cause is Cause.VENT_2
