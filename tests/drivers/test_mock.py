from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from bench.control.estimate.encoder import ENCODER_STATE, decode_encoders, design_encoders
from drivers.base import Command
from drivers.base.compiled import new_record
from drivers.base.records import READINGS, pack_readings
from drivers.mock import ATMOSPHERE, MockDriver

PERIOD = 1e-3
TRAVEL = ((-2.5, 2.5), (math.pi, 1.5 * math.pi), (4.8, 2.0 * math.pi))
ON = Command(supply_enable=True, exhaust_closed=True)


@pytest.fixture
def driver() -> MockDriver:
    made = MockDriver()
    made.open()
    return made


def angles(driver: MockDriver, time: float) -> Any:
    """The joint angles (rad) the bench sees at `time`."""
    readings, state = new_record(READINGS), new_record(ENCODER_STATE)
    parameters = design_encoders(
        counts_per_revolution=2**17, zero_count=(0.0,) * 3, sign=(1, 1, 1), travel=TRAVEL
    )
    pack_readings(driver.read(time), readings)
    decode_encoders(state, parameters, readings, time)
    assert state["fresh"][0].tolist() == [1, 1, 1]
    return state["angle"][0]


def test_mock_valve_command_is_joint_speed(driver: MockDriver) -> None:
    before = angles(driver, 0.0)
    assert before == pytest.approx([0.0, 4.0, 6.0], abs=1e-4)
    driver.write(ON._replace(valve=(0.5, -0.1, -1.0)))
    after = angles(driver, 0.02)
    assert after - before == pytest.approx([0.5 * 12 * 0.02, -0.1 * 10 * 0.02, -30 * 0.02], abs=1e-4)


@pytest.mark.parametrize("off", ["supply_enable", "exhaust_closed"])
def test_mock_without_air_does_not_move(driver: MockDriver, off: str) -> None:
    before = angles(driver, 0.0)
    driver.write(ON._replace(valve=(1.0, 1.0, -1.0), **{off: False}))
    np.testing.assert_array_equal(angles(driver, 1.0), before)


def test_mock_joints_stop_at_end_stops(driver: MockDriver) -> None:
    driver.read(0.0)
    driver.write(ON._replace(valve=(1.0, -1.0, -1.0)))
    assert angles(driver, 10.0) == pytest.approx([2.5, math.pi, 4.8], abs=1e-4)


def test_mock_readings_follow_attributes_and_command(driver: MockDriver) -> None:
    first = driver.read(0.0)
    assert (first.emergency_stop_clear, first.guard_closed, first.guard_locked) == (True, True, True)
    assert (first.local_reset, first.ball_present) == (False, False)
    assert first.supply_pressure == ATMOSPHERE
    assert all(map(math.isnan, first.chamber_pressure))
    driver.emergency_stop_clear = False
    driver.local_reset = True
    driver.write(ON._replace(guard_lock=False))
    second = driver.read(PERIOD)
    assert (second.emergency_stop_clear, second.local_reset, second.guard_locked) == (False, True, False)
    assert second.supply_pressure == 800_000.0
    driver.write(ON)
    driver.guard_closed = False
    third = driver.read(2 * PERIOD)
    assert (third.guard_closed, third.guard_locked) == (False, False)


def test_mock_rising_tee_places_single_ball(driver: MockDriver) -> None:
    driver.write(ON._replace(tee=True))
    assert driver.read(0.0).ball_present
    driver.ball_present = False
    driver.write(ON._replace(tee=True))
    assert not driver.read(PERIOD).ball_present
    driver.write(ON)
    driver.write(ON._replace(tee=True))
    assert driver.read(2 * PERIOD).ball_present


def test_mock_lost_encoder_keeps_last_count_and_ages(driver: MockDriver) -> None:
    first = driver.read(0.0)
    driver.write(ON._replace(valve=(0.0, 0.0, -1.0)))
    driver.encoder_valid = (True, True, False)
    lost = driver.read(0.004)
    assert lost.encoder_valid == (True, True, False)
    assert lost.encoder_count[2] == first.encoder_count[2]
    assert lost.encoder_age == pytest.approx((0.0, 0.0, 0.004))
    driver.encoder_valid = (True, True, True)
    back = driver.read(0.005)
    assert back.encoder_age == (0.0, 0.0, 0.0)
    assert back.encoder_count[2] != first.encoder_count[2]


def test_mock_encoder_never_valid_has_nan_time() -> None:
    driver = MockDriver()
    driver.encoder_valid = (False, True, True)
    driver.open()
    reading = driver.read(0.0)
    assert math.isnan(reading.encoder_time[0])
    assert math.isnan(reading.encoder_age[0])
