"""The `sim` driver: properties beyond the contract suite."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.records.telemetry.cycle_record import CYCLE
from drivers.base import PASSIVE, Command, DriverError
from drivers.base.compiled import new_record
from drivers.base.records import COMMAND, READINGS, pack_command, pack_readings
from sim.driver import SimDriver, hanging_pose
from sim.kane import bias_forces
from sim.plant import Encoders, PlantParameters, advance, build_plant, initial_state
from sim.sensors import contact_in

START = (0.2, 4.3, 6.0)
POWERED = Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True)
PERIOD = PlantParameters().tick


def opened(parameters: PlantParameters | None = None) -> SimDriver:
    driver = SimDriver(parameters, START)
    driver.open()
    return driver


def test_sim_driver_moves_plant_like_direct_advance() -> None:
    driver, plant = opened(), build_plant(PlantParameters())
    state, command = initial_state(plant, np.array(START)), new_record(COMMAND)
    pack_command(POWERED, command)
    driver.read(0.0)
    driver.write(POWERED)
    for k in range(1, 31):
        advance(*plant.records, state, command)
        if k % 3 == 0:  # ticks between two readings are made up
            driver.read(k * PERIOD)
    assert driver.plant_state["angle"].tobytes() == state["angle"].tobytes()
    assert driver.plant_state["pressure"].tobytes() == state["pressure"].tobytes()


@settings(max_examples=15, deadline=None)
@given(
    times=st.lists(st.floats(0.0, 0.05), min_size=1, max_size=12), start=st.sampled_from([0.0, 17.25, 1e6])
)
def test_sim_driver_plant_time_is_last_whole_tick(times: list[float], start: float) -> None:
    driver = opened()
    driver.read(start)
    for time in sorted(times):
        driver.read(start + time)
        ticks = round(float(driver.plant_state["time"][0]) / PERIOD)
        assert ticks * PERIOD <= time + 1.1e-6 * PERIOD + 1e-9
        assert time < (ticks + 1) * PERIOD + 1e-9


def test_sim_driver_reopened_reports_loop_times() -> None:
    driver = opened()
    for begin in (100.0, 7000.0):
        for k in range(4):
            readings = driver.read(begin + k * PERIOD)
            assert readings.time == pytest.approx(begin + k * PERIOD, abs=1e-9)
            assert readings.encoder_time[0] == pytest.approx(readings.time - Encoders().latency, abs=1e-9)
            driver.write(POWERED)
        driver.close()
        driver.open()
    assert float(driver.plant_state["time"][0]) == pytest.approx(6 * PERIOD)


def test_sim_driver_make_passive_vents_supply() -> None:
    driver = opened()
    driver.read(0.0)
    driver.write(POWERED)
    driver.read(0.02)
    charged = driver.plant_state["supply_pressure"][0]
    driver.make_passive()
    driver.read(0.06)
    assert driver.applied == PASSIVE
    assert driver.plant_state["supply_pressure"][0] < charged


def test_sim_driver_lost_encoder_reads_invalid() -> None:
    driver = opened()
    driver.plant_state["encoder_valid"] = (1, 0, 1)
    assert driver.read(0.0).encoder_valid == (True, False, True)


def test_sim_driver_equal_seeds_give_equal_noise() -> None:
    runs = []
    for seed in (1, 1, 2):
        driver = opened(PlantParameters(encoders=Encoders(jitter=1e-4, noise=1e-3), seed=seed))
        runs.append([driver.read(k * PERIOD).encoder_count for k in range(5)])
    assert runs[0] == runs[1] != runs[2]


def test_sim_driver_note_truth_fills_record() -> None:
    driver = opened()
    driver.read(0.005)
    record = new_record(CYCLE)
    driver.note_truth(record)
    assert record["plant_angle"][0].tolist() == driver.plant_state["angle"][0].tolist()
    assert record["plant_pressure"][0].tolist() == driver.plant_state["pressure"][0].tolist()
    assert record["plant_head_speed"][0] >= 0.0


def test_sim_driver_contact_after_impact_gives_launch() -> None:
    driver = opened()
    driver.place_ball()
    assert contact_in(driver.plant_state) is None
    assert driver.read(0.0).ball_present
    state = driver.plant_state
    state["struck"], state["impact_time"] = True, 1.25
    state["impact_head"], state["ball_velocity"] = (0.2, -1.5, 4.7, 40.0, 1.0, 30.0), (55.0, 15.0, 1.0)
    state["ball_spin"] = (0.0, 0.0, 300.0)
    contact = driver.contact
    assert contact is not None
    assert contact == contact_in(state)
    assert (contact.time, contact.head, contact.head_velocity) == (1.25, (0.2, -1.5, 4.7), (40.0, 1.0, 30.0))
    assert contact.launch.speed == pytest.approx(math.sqrt(55**2 + 15**2 + 1))
    driver.place_ball()
    assert driver.contact is None


def test_hanging_pose_is_in_equilibrium() -> None:
    parameters = PlantParameters()
    pose = hanging_pose(parameters)
    shoulder, arm, wrist = bias_forces(parameters.robot, pose, np.zeros(3))
    assert abs(shoulder) < 1e-6  # free to swing, and at its lowest
    assert arm < 0  # pulled outwards against its end
    assert wrist < 0
    assert parameters.wrist.lower <= pose[2] <= parameters.wrist.upper


@pytest.mark.parametrize("angle", [(0.1, 4.0), (0.1, 4.0, math.nan), 3.0])
def test_sim_driver_invalid_start_angles_raise(angle: object) -> None:
    with pytest.raises(ValueError, match=r"start angles"):
        SimDriver(angle=angle)  # type: ignore[arg-type]


def test_sim_driver_read_of_past_time_names_earliest_time() -> None:
    driver = opened()
    driver.read(2.0)
    driver.read(2.005)
    with pytest.raises(DriverError, match=r"at least 2\.005 s"):
        driver.read(2.001)


@pytest.mark.parametrize("start", [0.0, 12.5])
def test_sim_driver_read_record_equals_read(start: float) -> None:
    one, other = SimDriver(PlantParameters()), SimDriver(PlantParameters())
    one.open()
    other.open()
    packed, record = new_record(READINGS), new_record(READINGS)
    for k in range(40):
        pack_readings(one.read(start + 1e-3 * k), packed)
        other.read_record(start + 1e-3 * k, record)
        for name in READINGS.names or ():
            np.testing.assert_array_equal(record[name], packed[name])
