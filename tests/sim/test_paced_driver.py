"""The plant in step with the loop in a bench that lives: hands around it, eyes on its balls."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.base import PASSIVE, DriverError
from sim.ball import Ball
from sim.driver import PacedPlantDriver, SimDriver
from sim.exchange import REPORT_FILE, SURROUNDINGS_FILE, ContactMonitor, SurroundingsWriter, warm_up
from sim.plant import PlantParameters


@pytest.fixture
def driver(tmp_path: Path) -> Iterator[PacedPlantDriver]:
    made = PacedPlantDriver(tmp_path, PlantParameters())
    made.open()
    yield made
    made.close()


def strike(driver: PacedPlantDriver, time: float, speed: float) -> None:
    """Let the plant have struck a ball, as its tick does."""
    driver.read(time)
    state = driver.plant_state
    state["ball_velocity"], state["struck"] = [speed, 10.0, 0.0], True
    driver.read(time)


def attached(watch: ContactMonitor) -> bool:
    watch.attach()
    return watch.attached


def test_paced_driver_without_surroundings_equals_sim_driver(driver: PacedPlantDriver) -> None:
    alone = SimDriver(PlantParameters())
    alone.open()
    for k in range(50):
        assert repr(driver.read(k * 1e-3)) == repr(alone.read(k * 1e-3))  # NaN where no feedback is fitted
        assert driver.write(PASSIVE) == alone.write(PASSIVE)
    assert driver.operational


def test_paced_driver_applies_surroundings(driver: PacedPlantDriver, tmp_path: Path) -> None:
    assert driver.read(0.0).guard_closed
    with SurroundingsWriter(tmp_path) as hands:
        hands.change(guard_closed=False)
        opened = driver.read(0.001)
        assert not opened.guard_closed
        hands.change(guard_closed=True, frozen=True)
        frozen = driver.read(0.003)
        assert frozen.time == 0.003
        assert frozen.encoder_age[0] == pytest.approx(0.002 + opened.encoder_age[0])
        hands.change(frozen=False)
        hands.place_ball()
        assert driver.read(0.004).ball_present
        before = driver.plant.impact.copy()
        hands.choose_ball(replace(Ball("slow"), restitution_factor=0.9))
        driver.read(0.005)
        assert driver.plant.impact["restitution"] == pytest.approx(0.9 * before["restitution"])
        hands.choose_ball(None)
        driver.read(0.006)
        assert np.array_equal(driver.plant.impact, before)


def test_contact_monitor_reports_each_contact_once(driver: PacedPlantDriver, tmp_path: Path) -> None:
    warm_up()
    watch = ContactMonitor(tmp_path)
    assert watch.look() is None  # not attached yet
    assert attached(watch)
    assert watch.look() is None
    strike(driver, 0.001, 60.0)
    contact = watch.look()
    assert contact is not None
    assert contact.ball_velocity[0] == 60.0
    assert contact.launch.speed == pytest.approx(np.hypot(60.0, 10.0))
    assert watch.look() is None
    with SurroundingsWriter(tmp_path) as hands:
        hands.place_ball()
    driver.read(0.002)
    strike(driver, 0.003, 61.0)
    again = watch.look()
    assert again is not None
    assert again.ball_velocity[0] == 61.0

    driver.close()
    assert not (tmp_path / REPORT_FILE).exists()
    assert not (tmp_path / SURROUNDINGS_FILE).exists()
    assert not attached(watch)
    driver.open()
    assert attached(watch)
    assert watch.look() is None  # what another plant did is no news
    watch.close()


def test_paced_driver_second_open_raises(driver: PacedPlantDriver) -> None:
    with pytest.raises(DriverError, match="already open"):
        driver.open()
