"""The driver contract, run on every driver. A new driver adds one line to DRIVERS."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.base import PASSIVE, READINGS, Command, Driver, DriverError, Readings, pack_readings
from drivers.mock import MockDriver
from sim.compiled import new_record
from sim.driver import SimDriver

PERIOD = 1e-3
MOVING = Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True, beacon=True)


class Case(NamedTuple):
    """How the suite gets at a driver: a fresh, closed one, and the command truly in force in it."""

    make: Callable[[], Driver]
    in_force: Callable[[Driver], Command]


def _applied(driver: Driver) -> Command:
    applied = driver.applied  # type: ignore[attr-defined]  # the probe of simulated drivers
    assert isinstance(applied, Command)
    return applied


DRIVERS: dict[str, Case] = {
    "mock": Case(MockDriver, _applied),
    "sim": Case(lambda: SimDriver(angle=(0.2, 4.3, 6.0)), _applied),
}


@pytest.fixture(params=DRIVERS)
def case(request: pytest.FixtureRequest) -> Case:
    return DRIVERS[request.param]


@pytest.fixture
def driver(case: Case) -> Iterator[Driver]:
    made = case.make()
    yield made
    made.close()


@pytest.fixture
def opened(driver: Driver) -> Driver:
    driver.open()
    return driver


def ticks(driver: Driver, count: int, start: float = 0.0, command: Command = MOVING) -> list[Readings]:
    taken = []
    for k in range(count):
        taken.append(driver.read(start + k * PERIOD))
        driver.write(command)
    return taken


def test_it_is_a_driver(driver: Driver) -> None:
    assert isinstance(driver, Driver)


def test_reading_and_writing_need_an_open_device(case: Case) -> None:
    driver = case.make()
    for state in ("new", "closed"):
        with pytest.raises(DriverError, match=r"open"):
            driver.read(0.0)
        with pytest.raises(DriverError, match=r"open"):
            driver.write(PASSIVE)
        if state == "new":
            driver.open()
            driver.close()


def test_opening_twice_is_refused_and_changes_nothing(opened: Driver, case: Case) -> None:
    ticks(opened, 2)
    with pytest.raises(DriverError, match=r"open"):
        opened.open()
    assert case.in_force(opened) == MOVING


def test_it_can_be_opened_again_after_closing(driver: Driver, case: Case) -> None:
    for _ in range(2):
        driver.open()
        assert case.in_force(driver) == PASSIVE
        ticks(driver, 3)
        driver.close()
        driver.close()


def test_passive_and_close_are_allowed_in_any_state(driver: Driver, case: Case) -> None:
    driver.make_passive()
    driver.close()
    driver.make_passive()
    driver.open()
    driver.make_passive()
    driver.make_passive()
    assert case.in_force(driver) == PASSIVE
    driver.close()
    driver.make_passive()
    driver.make_passive()


@settings(max_examples=30, deadline=None)
@given(calls=st.lists(st.sampled_from(["open", "read", "write", "make_passive", "close"]), max_size=20))
def test_any_order_of_calls_ends_in_a_driver_error_or_works(calls: list[str]) -> None:
    for case in DRIVERS.values():
        driver = case.make()
        is_open = False
        for k, call in enumerate(calls):
            if call == "make_passive":
                driver.make_passive()
                assert case.in_force(driver) == PASSIVE
            elif call == "close":
                driver.close()
                is_open = False
            elif call == "open" and not is_open:
                driver.open()
                is_open = True
            elif not is_open or call == "open":
                arguments = {"open": (), "read": (0.0,), "write": (MOVING,)}[call]
                with pytest.raises(DriverError):
                    getattr(driver, call)(*arguments)
            elif call == "read":
                assert isinstance(driver.read(k * PERIOD), Readings)
            else:
                assert driver.write(MOVING) == MOVING
        driver.close()


def test_passive_is_applied_and_a_new_command_works_after_it(opened: Driver, case: Case) -> None:
    ticks(opened, 5)
    assert case.in_force(opened) == MOVING
    opened.make_passive()
    assert case.in_force(opened) == PASSIVE
    opened.read(0.1)
    assert case.in_force(opened) == PASSIVE
    assert opened.write(MOVING) == MOVING


def test_closing_leaves_it_passive(opened: Driver, case: Case) -> None:
    ticks(opened, 5)
    opened.close()
    assert case.in_force(opened) == PASSIVE


@pytest.mark.parametrize(
    ("asked", "applied"),
    [
        ((0.5, -0.5, 0.0), (0.5, -0.5, 0.0)),
        ((1.0, -1.0, 0.0), (1.0, -1.0, 0.0)),
        ((1.5, -7.0, 1e300), (1.0, -1.0, 1.0)),
    ],
)
def test_the_command_applied_is_returned(
    opened: Driver, case: Case, asked: tuple[float, float, float], applied: tuple[float, float, float]
) -> None:
    opened.read(0.0)
    expected = MOVING._replace(valve=applied)
    assert opened.write(MOVING._replace(valve=asked)) == expected
    assert case.in_force(opened) == expected


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("valve", range(3))
def test_an_opening_that_is_not_finite_makes_it_passive(
    opened: Driver, case: Case, bad: float, valve: int
) -> None:
    ticks(opened, 2)
    openings = [0.2, 0.2, 0.2]
    openings[valve] = bad
    assert opened.write(MOVING._replace(valve=(openings[0], openings[1], openings[2]))) == PASSIVE
    assert case.in_force(opened) == PASSIVE


def test_readings_have_their_types_and_fit_the_record(opened: Driver) -> None:
    for reading in ticks(opened, 20):
        assert isinstance(reading, Readings)
        assert isinstance(reading.time, float)
        for name, kind in (("encoder_count", int), ("encoder_valid", bool)):
            values = getattr(reading, name)
            assert isinstance(values, tuple)
            assert [type(v) for v in values] == [kind] * 3
        for name, length in (("encoder_time", 3), ("encoder_age", 3), ("chamber_pressure", 6)):
            values = getattr(reading, name)
            assert isinstance(values, tuple)
            assert [type(v) for v in values] == [float] * length
        for name in ("emergency_stop_clear", "guard_closed", "guard_locked", "local_reset", "ball_present"):
            assert type(getattr(reading, name)) is bool
        assert math.isnan(reading.supply_pressure) or reading.supply_pressure > 5e4
        assert all(
            math.isnan(p) or p > 5e4 for p in reading.chamber_pressure
        )  # absent or absolute, never zero
        pack_readings(reading, new_record(READINGS))


def test_times_run_forward_and_ages_belong_to_them(opened: Driver) -> None:
    readings = ticks(opened, 50)
    stamps = np.array([r.encoder_time for r in readings])
    assert np.all(np.diff(stamps, axis=0) >= 0)
    for k, r in enumerate(readings):
        assert r.time == pytest.approx(k * PERIOD, abs=1e-12)
        for time, age, valid in zip(r.encoder_time, r.encoder_age, r.encoder_valid, strict=True):
            if valid:
                assert time <= r.time
                assert age == pytest.approx(r.time - time, abs=1e-12)
                assert 0 <= age < 0.01
    assert any(all(r.encoder_valid) for r in readings)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0])
def test_a_time_that_does_not_run_forward_is_refused(opened: Driver, bad: float) -> None:
    opened.read(1.0)
    with pytest.raises(DriverError, match=r"time"):
        opened.read(bad)


def test_the_same_calls_give_the_same_readings(case: Case) -> None:
    runs = []
    for _ in range(2):
        driver = case.make()
        driver.open()
        packed = new_record(READINGS)
        rows = []
        for reading in ticks(driver, 40):
            pack_readings(reading, packed)
            rows.append(packed.tobytes())
        runs.append(rows)
        driver.close()
    assert runs[0] == runs[1]
