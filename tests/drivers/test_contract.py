"""The driver contract, run on every driver. A new driver adds one line to DRIVERS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from itertools import product
from typing import NamedTuple

import nidaqmx._library_interpreter
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.base import PASSIVE, Command, Driver, DriverError, Readings
from drivers.base.compiled import new_record
from drivers.base.records import READINGS, pack_readings
from drivers.canopen.driver import CanopenDriver
from drivers.daq.driver import DaqDriver
from drivers.mock import MockDriver
from sim.driver import SimDriver
from tests.drivers.canopen.in_step import Wire, make
from tests.drivers.canopen.nodes_process import NodesProcess, rounded
from tests.drivers.daq.system import System, command_of, driver_on

PERIOD = 1e-3
MOVING = Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True, beacon=True)


class Case(NamedTuple):
    """How the suite gets at a driver: a fresh, closed one, and the command truly in force in it."""

    make: Callable[[], Driver]
    in_force: Callable[[Driver], Command]
    on_wall: bool = False
    """Its time is the wall's, which a test can only follow."""


def _applied(driver: Driver) -> Command:
    applied = driver.applied  # type: ignore[attr-defined]  # the probe of simulated drivers
    assert isinstance(applied, Command)
    return applied


_WIRES: dict[int, Wire] = {}
"""The wire of each driver in step, by the driver's id."""


def in_step() -> Driver:
    driver, wire = make()
    driver.open()  # a node that was never set up falls back to 0 V, which is full stroke
    driver.close()
    _WIRES[id(driver)] = wire
    return driver


_SYSTEM = System()
"""NI's driver, with a card for each driver made."""


def on_card() -> Driver:
    driver = driver_on(_SYSTEM)
    driver.open()  # a card that was never opened is at 0 V, which is full stroke
    driver.close()
    return driver


def command_on_card(driver: Driver) -> Command:
    assert isinstance(driver, DaqDriver)
    return rounded(command_of(_SYSTEM.cards[driver.settings.device], driver.settings))


_NODES: list[NodesProcess] = []
"""The nodes of this module while a live test needs them."""


@pytest.fixture(scope="module", autouse=True)
def _devices(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Put simulated cards behind NI's driver; run nodes as a process if a live test is selected."""
    here = (item for item in request.session.items if item.path == request.path)
    with ExitStack() as stack:
        if any(item.get_closest_marker("live") for item in here):
            _NODES.append(NodesProcess(tmp_path_factory.mktemp("nodes")))
            first = CanopenDriver(_NODES[0].settings, watchdog=0.5)
            first.open()  # a node that was never set up falls back to 0 V, which is full stroke
            first.close()
            stack.callback(lambda: _NODES.pop().end())
        patched = stack.enter_context(pytest.MonkeyPatch.context())
        patched.setattr(nidaqmx._library_interpreter, "LibraryInterpreter", lambda: _SYSTEM)
        yield
    _WIRES.clear()


DRIVERS: dict[str, Case] = {
    "mock": Case(MockDriver, _applied),
    "sim": Case(lambda: SimDriver(angle=(0.2, 4.3, 6.0)), _applied),
    "canopen in step": Case(in_step, lambda driver: _WIRES[id(driver)].in_force),
    "canopen": Case(
        lambda: CanopenDriver(_NODES[0].settings, watchdog=0.5), lambda _: _NODES[0].settled(), on_wall=True
    ),
    "daq": Case(on_card, command_on_card),
}


@pytest.fixture(
    params=[
        pytest.param(name, marks=pytest.mark.live if case.on_wall else ()) for name, case in DRIVERS.items()
    ]
)
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


def times(driver: Driver, count: int) -> Iterator[float]:
    """Give the times of ticks: counted, or the wall's."""
    on_wall = getattr(driver, "clock", None) is time.monotonic
    start = time.monotonic()
    for k in range(count):
        if on_wall:
            time.sleep(max(0.0, start + k * PERIOD - time.monotonic()))
        yield time.monotonic() if on_wall else k * PERIOD


def ticks(driver: Driver, count: int) -> list[Readings]:
    taken = []
    for now in times(driver, count):
        taken.append(driver.read(now))
        assert taken[-1].time == pytest.approx(now, abs=1e-12)
        driver.write(MOVING)
    return taken


def test_driver_implements_protocol(driver: Driver) -> None:
    assert isinstance(driver, Driver)


def test_read_and_write_while_closed_raise(case: Case) -> None:
    driver = case.make()
    for state in ("new", "closed"):
        with pytest.raises(DriverError, match=r"open"):
            driver.read(0.0)
        with pytest.raises(DriverError, match=r"open"):
            driver.write(PASSIVE)
        if state == "new":
            driver.open()
            driver.close()


def test_open_twice_is_refused_and_keeps_command(opened: Driver, case: Case) -> None:
    ticks(opened, 2)
    with pytest.raises(DriverError, match=r"open"):
        opened.open()
    assert case.in_force(opened) == MOVING


def test_open_after_close_works_and_is_passive(driver: Driver, case: Case) -> None:
    for _ in range(2):
        driver.open()
        assert case.in_force(driver) == PASSIVE
        ticks(driver, 3)
        driver.close()
        driver.close()


def test_make_passive_and_close_work_in_any_state(driver: Driver, case: Case) -> None:
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


any_calls = st.lists(st.sampled_from(["open", "read", "write", "make_passive", "close"]), max_size=20)


@pytest.mark.live
@settings(max_examples=30, deadline=None)
@given(calls=any_calls)
def test_call_order_live_works_or_raises_driver_error(calls: list[str]) -> None:
    call_in_order(calls, DRIVERS.values())


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(calls=any_calls)
def test_call_order_lock_step_works_or_raises_driver_error(calls: list[str]) -> None:
    call_in_order(calls, (case for case in DRIVERS.values() if not case.on_wall))


def call_in_order(calls: list[str], cases: Iterable[Case]) -> None:
    """Make `calls` on a new driver of each case: they work, or end in a driver error."""
    for case in cases:
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


def test_make_passive_applies_until_next_command(opened: Driver, case: Case) -> None:
    last = ticks(opened, 5)[-1].time
    assert case.in_force(opened) == MOVING
    opened.make_passive()
    assert case.in_force(opened) == PASSIVE
    opened.read(last + 0.1)
    assert case.in_force(opened) == PASSIVE
    assert opened.write(MOVING) == MOVING


def test_close_leaves_passive_command(opened: Driver, case: Case) -> None:
    ticks(opened, 5)
    opened.close()
    assert case.in_force(opened) == PASSIVE


def test_write_returns_applied_command(opened: Driver, case: Case) -> None:
    opened.read(0.0)
    for asked, applied in (
        ((0.5, -0.5, 0.0), (0.5, -0.5, 0.0)),
        ((1.0, -1.0, 0.0), (1.0, -1.0, 0.0)),
        ((1.5, -7.0, 1e300), (1.0, -1.0, 1.0)),
    ):
        expected = MOVING._replace(valve=applied)
        assert opened.write(MOVING._replace(valve=asked)) == expected, asked
        assert case.in_force(opened) == expected, asked


def test_write_non_finite_valve_applies_passive(opened: Driver, case: Case) -> None:
    ticks(opened, 2)
    for valve, bad in product(range(3), (math.nan, math.inf, -math.inf)):
        openings = [0.2, 0.2, 0.2]
        openings[valve] = bad
        command = MOVING._replace(valve=(openings[0], openings[1], openings[2]))
        assert opened.write(MOVING) == MOVING, openings
        assert case.in_force(opened) == MOVING, openings
        assert opened.write(command) == PASSIVE, openings
        assert case.in_force(opened) == PASSIVE, openings


def test_readings_have_types_and_pack_into_record(opened: Driver) -> None:
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
        # Absent or absolute, never zero.
        assert all(math.isnan(p) or p > 5e4 for p in reading.chamber_pressure)
        pack_readings(reading, new_record(READINGS))


def test_encoder_times_never_decrease_and_ages_match(opened: Driver, case: Case) -> None:
    readings = ticks(opened, 50)
    stamps = np.array([r.encoder_time for r in readings])
    assert not np.any(np.diff(stamps, axis=0) < 0)  # the first ones may be missing: not a number
    soon, long = (-0.005, 1.0) if case.on_wall else (0.0, 0.01)  # a busy machine between two lines
    for r in readings:
        for stamp, age, valid in zip(r.encoder_time, r.encoder_age, r.encoder_valid, strict=True):
            if valid:
                assert age == pytest.approx(r.time - stamp, abs=1e-12)
                assert soon <= age < long
    assert any(all(r.encoder_valid) for r in readings)


def test_read_first_time_of_minus_infinity_is_refused(opened: Driver) -> None:
    with pytest.raises(DriverError):
        opened.read(-math.inf)


def test_read_time_not_increasing_is_refused(opened: Driver) -> None:
    for k, bad in enumerate((math.nan, math.inf, 0.0)):
        opened.read(k + 1.0)
        with pytest.raises(DriverError, match=r"time"):
            pytest.fail(f"{bad} gives {opened.read(bad)}")


@pytest.mark.parametrize("name", [name for name, case in DRIVERS.items() if not case.on_wall])
def test_same_calls_give_identical_readings(name: str) -> None:
    case, runs = DRIVERS[name], []
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
