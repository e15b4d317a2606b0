from __future__ import annotations

import builtins
import inspect
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import nidaqmx._base_interpreter
import nidaqmx._library_interpreter
import pytest

from drivers.base import INVALID, PASSIVE, Command, DriverError
from drivers.daq.driver import PRESET, DaqDriver
from drivers.daq.settings import DaqSettings, OutputLines
from tests.drivers.daq.system import Card, System

MOVING = Command((0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True, guard_lock=False, tee=True)
FULL = DaqSettings(supply_pressure="ai0", chamber_pressures=("ai1", "ai2", "", "ai3", "ai4", "ai5"))
SYNC = replace(FULL, sync_line="port0/line5")
RELAY = replace(FULL, watchdog_relay="K1", watchdog_line="port0/line6")


@pytest.fixture
def system(monkeypatch: pytest.MonkeyPatch) -> System:
    made = System()
    made.cards["Dev1"] = Card()
    monkeypatch.setattr(nidaqmx._library_interpreter, "LibraryInterpreter", lambda: made)
    return made


@pytest.fixture
def card(system: System) -> Card:
    return system.cards["Dev1"]


class Bench:
    """Makes drivers whose clock is the card's, and closes them."""

    def __init__(self, card: Card) -> None:
        self._card = card
        self.made: list[DaqDriver] = []

    def __call__(self, settings: DaqSettings = FULL, **more: Any) -> DaqDriver:
        def sleep(duration: float) -> None:
            self._card.now += duration

        driver = DaqDriver(settings, clock=lambda: self._card.now, sleep=sleep, **more)
        self.made.append(driver)
        return driver


@pytest.fixture
def bench(card: Card, system: System) -> Iterator[Bench]:
    made = Bench(card)
    yield made
    for driver in made.made:
        driver.close()
    assert system.tasks == []  # nothing is left on the card


@pytest.fixture
def driver(bench: Bench) -> DaqDriver:
    made = bench()
    made.open()
    return made


def valves(card: Card) -> tuple[float, float, float]:
    return card.volts["ao0"], card.volts["ao1"], card.volts["ao2"]


def outputs(card: Card) -> list[bool]:
    return [card.lines[line] for line in vars(OutputLines()).values()]


def test_simulated_system_matches_nidaqmx_signatures() -> None:
    for name, method in vars(System).items():
        real = getattr(nidaqmx._base_interpreter.BaseInterpreter, name, None)
        if real is not None and inspect.isfunction(method) and not name.startswith("_"):
            if method.__qualname__.startswith("System."):
                assert list(inspect.signature(method).parameters) == list(inspect.signature(real).parameters)


def test_open_writes_only_centred_valves(driver: DaqDriver, card: Card) -> None:
    assert valves(card) == (5.0, 5.0, 5.0)
    assert set(card.written) == {(5.0, 5.0, 5.0)}
    assert outputs(card) == [False] * 5
    assert driver.operational


def test_open_tests_watchdog_before_outputs(driver: DaqDriver, card: Card) -> None:
    calls = card.calls
    assert calls.index("cfg_watchdog_ao") < calls.index("expired") < calls.index("create_ao")
    assert card.now >= 0.02


def test_write_sets_valves_and_outputs(driver: DaqDriver, card: Card) -> None:
    driver.read(0.0)
    assert driver.write(MOVING) == MOVING
    assert valves(card) == pytest.approx((6.5, 4.0, 5.5))
    assert outputs(card) == [True, True, True, False, True]


def test_read_returns_encoders_inputs_and_pressures(driver: DaqDriver, card: Card) -> None:
    card.motion |= {"ctr0": 1000, "ctr1": -1, "ctr2": 3 * 2**17 + 5}
    card.lines |= {"port0/line0": True, "port0/line2": True, "port0/line4": True}
    card.levels["ai0"], card.levels["ai3"] = 5.0, 2.5
    seen = driver.read(0.25)
    assert seen.encoder_count == (1000, 2**17 - 1, 5)
    assert seen.encoder_time == (0.25, 0.25, 0.25)
    assert seen.encoder_valid == (True, True, True)
    assert seen.encoder_indexed == (True, True, True)
    assert (seen.emergency_stop_clear, seen.guard_closed, seen.guard_locked) == (True, False, True)
    assert (seen.local_reset, seen.ball_present) == (False, True)
    assert seen.supply_pressure == pytest.approx(8e5)
    assert math.isnan(seen.chamber_pressure[2])
    assert seen.chamber_pressure[0] == pytest.approx(0.8e5)
    driver.read(0.26)
    card.levels["ai0"] = 6.0
    assert driver.read(0.27).supply_pressure == pytest.approx(8e5)  # of the last time they were read
    for tick in range(10):
        seen = driver.read(0.28 + tick / 1000)
    assert seen.supply_pressure == pytest.approx(9.6e5)


RATIOMETRIC = {"pressure_at_zero": -2e5, "pressure_at_full_scale": 3.8e6, "highest_pressure": 1.7e6}
"""0.5 V at 0 bar, 4.5 V at 16 bar."""


@pytest.mark.parametrize(
    ("scale", "volts"),
    [({}, 0.0), ({}, 0.1), ({}, 10.0), (RATIOMETRIC, 0.0), (RATIOMETRIC, 0.45), (RATIOMETRIC, 5.0)],
)
def test_pressure_sensor_cut_or_shorted_is_invalid(
    scale: dict[str, Any], volts: float, card: Card, bench: Bench
) -> None:
    driver = bench(settings=replace(FULL, **scale))
    driver.open()
    card.levels |= dict.fromkeys(("ai0", "ai1", "ai2", "ai3", "ai4", "ai5"), 1.0)
    assert math.isfinite(driver.read(0.0).chamber_pressure[0])
    card.levels |= {"ai0": volts, "ai1": volts}
    seen = [driver.read(0.001 + tick / 1000) for tick in range(12)][-1]
    assert seen.supply_pressure == seen.chamber_pressure[0] == INVALID
    assert math.isfinite(seen.chamber_pressure[1])
    assert math.isnan(seen.chamber_pressure[2])  # not fitted


def test_spool_positions_are_read_each_tick(card: Card, bench: Bench) -> None:
    driver = bench(settings=replace(FULL, spool_positions=("ai6", "", "ai7")))
    driver.open()
    card.levels |= {"ai0": 5.0, "ai6": 5.0, "ai7": 7.5}
    seen = driver.read(0.0)
    assert seen.supply_pressure == pytest.approx(8e5)
    assert (seen.spool_position[0], seen.spool_position[2]) == pytest.approx((0.0, 0.5))
    assert math.isnan(seen.spool_position[1])  # not fitted
    card.levels["ai7"] = 0.0
    assert driver.read(0.001).spool_position[2] == pytest.approx(-1.0)


def test_spool_position_live_zero_cut_cable_is_invalid(card: Card, bench: Bench) -> None:
    driver = bench(settings=replace(FULL, spool_positions=("ai6", "", ""), spool_at_zero=-1.5))
    driver.open()
    card.levels["ai6"] = 0.0
    assert driver.read(0.0).spool_position[0] == INVALID


def test_vent_feedback_reads_open_closed_or_invalid(card: Card, bench: Bench) -> None:
    driver = bench(settings=replace(FULL, vent_feedback=("port0/line5", "port0/line6")))
    driver.open()
    card.lines |= {"port0/line5": True}
    assert driver.read(0.0).vent_open == (1.0, 0.0)
    card.gone = True
    assert driver.read(0.001).vent_open == (INVALID, INVALID)


@pytest.mark.parametrize("vents", [("", ""), ("port0/line5", "port0/line6")])
def test_shut_off_feedback_reads_open_closed_or_invalid(
    card: Card, bench: Bench, vents: tuple[str, str]
) -> None:
    driver = bench(settings=replace(FULL, vent_feedback=vents, shut_off_feedback="port0/line7"))
    driver.open()
    assert driver.read(0.0).shut_off_open == 0.0
    card.lines |= {"port0/line7": True}
    assert driver.read(0.001).shut_off_open == 1.0
    card.gone = True
    assert driver.read(0.002).shut_off_open == INVALID


@pytest.mark.parametrize("unsigned", [False, True])
def test_encoder_indexed_is_derived_from_count(bench: Bench, card: Card, unsigned: bool) -> None:
    card.unsigned = unsigned
    card.indexed["ctr1"] = False
    driver = bench()
    driver.open()
    for motion in (0, 50_000, -50_000):
        card.motion["ctr1"] = motion
        seen = driver.read(0.0)
        assert seen.encoder_indexed == (True, False, True)
        assert seen.encoder_count[1] == (PRESET + motion) % 2**17
    card.indexed["ctr1"], card.motion["ctr1"] = True, -7
    seen = driver.read(0.0)
    assert seen.encoder_indexed == (True, True, True)
    assert seen.encoder_count[1] == 2**17 - 7


def test_search_index_starts_once_per_request(driver: DaqDriver, card: Card) -> None:
    assert driver.read(0.0).encoder_indexed == (True, True, True)
    assert driver.write(PASSIVE._replace(search_index=True)).search_index
    assert driver.read(0.001).encoder_indexed == (False, False, False)
    card.indexed["ctr2"] = True
    driver.write(PASSIVE._replace(search_index=True))
    assert driver.read(0.002).encoder_indexed == (False, False, True)
    driver.write(PASSIVE)
    assert driver.read(0.003).encoder_indexed == (False, False, True)
    driver.write(PASSIVE._replace(search_index=True))
    assert driver.read(0.004).encoder_indexed == (False, False, False)


def test_open_configures_counters_for_encoders(driver: DaqDriver, system: System) -> None:
    counters = [task for task in system.tasks if task.kind == "ci"]
    assert [task.channels for task in counters] == [["Dev1/ctr0"], ["Dev1/ctr1"], ["Dev1/ctr2"]]
    for task in counters:
        assert task.arguments == {
            "index": True,
            "value": 0.0,
            "phase": 10040,
            "pulses": 2**15,
            "initial": float(PRESET),
        }


def test_lost_counter_keeps_last_count_and_ages(driver: DaqDriver, card: Card) -> None:
    card.motion["ctr1"] = 77
    driver.read(1.0)
    card.stuck.add("ctr1")
    card.motion["ctr1"] = 99
    seen = driver.read(1.5)
    assert seen.encoder_count[1] == 77
    assert seen.encoder_age == (0.0, 0.5, 0.0)
    assert driver.missing == 1
    assert driver.operational
    card.stuck.clear()
    assert driver.read(1.6).encoder_count[1] == 99


def test_watchdog_loss_of_communication_faults_until_reopened(driver: DaqDriver, card: Card) -> None:
    for tick in range(5):
        card.now += 0.019
        driver.read(tick * 0.019)
        assert driver.write(MOVING) == MOVING
    card.now += 0.021
    assert driver.write(MOVING) == PASSIVE
    assert valves(card) == (5.0, 5.0, 5.0)
    assert outputs(card) == [False] * 5
    assert "watchdog" in driver.fault
    assert driver.write(MOVING) == PASSIVE
    driver.close()
    driver.open()
    assert driver.operational
    assert driver.write(MOVING) == MOVING


def test_watchdog_pause_before_first_command_is_ignored(driver: DaqDriver, card: Card) -> None:
    card.now += 100.0
    assert driver.write(MOVING) == MOVING


def test_removed_card_faults_and_open_is_refused(driver: DaqDriver, card: Card) -> None:
    driver.write(MOVING)
    card.gone = True
    card.lines["port0/line0"] = True
    seen = driver.read(1.0)
    assert not seen.emergency_stop_clear
    assert seen.supply_pressure == INVALID
    assert driver.fault
    assert driver.write(MOVING) == PASSIVE
    driver.make_passive()
    driver.close()
    with pytest.raises(DriverError, match=r"found the devices none, expected Dev1"):
        driver.open()
    card.gone = False


def test_make_passive_failed_write_leaves_watchdog_to_centre(
    driver: DaqDriver, card: Card, monkeypatch: pytest.MonkeyPatch, system: System
) -> None:
    driver.write(MOVING)

    def fail(*_: Any) -> int:
        raise OSError("a mistake of the driver")

    with monkeypatch.context() as patched:
        patched.setattr(System, "write_analog_f64", fail)
        driver.make_passive()
        assert not driver.operational
        driver.close()
    assert valves(card) == (5.0, 5.0, 5.0)  # by the watchdog, for which it has waited
    assert system.tasks == []


@pytest.mark.parametrize("lacks", ["has_watchdog", "watchdog_works"])
def test_card_without_watchdog_is_refused_unless_relay(bench: Bench, card: Card, lacks: str) -> None:
    setattr(card, lacks, False)
    with pytest.raises(DriverError, match=r"0 V is full stroke.*daq\.watchdog_relay"):
        bench().open()
    assert card.written == []
    driver = bench(RELAY)
    driver.open()
    beats = []
    for tick in range(4):
        driver.read(tick / 1000)
        assert driver.write(MOVING) == MOVING
        beats.append(card.lines["port0/line6"])
    assert beats == [True, False, True, False]
    driver.make_passive()
    assert valves(card) == (5.0, 5.0, 5.0)


def test_watchdog_relay_after_fault_is_not_fed(bench: Bench, card: Card) -> None:
    driver = bench(RELAY)
    driver.open()
    driver.fault = "a test's fault"
    before = card.lines["port0/line6"]
    for _ in range(3):
        driver.write(MOVING)
        assert card.lines["port0/line6"] == before


def test_watchdog_fallback_wrong_read_back_is_refused(bench: Bench, card: Card) -> None:
    card.coarse = -5.0
    with pytest.raises(DriverError, match=r"Dev1/ao0: found a fallback of 0 V \(VOLTAGE\), expected 5 V"):
        bench().open()
    card.coarse = 0.01
    bench().open()


def test_sync_line_edge_latches_all_counters(bench: Bench, card: Card) -> None:
    driver = bench(SYNC)
    driver.open()
    assert driver.hardware_timed
    card.motion |= {"ctr0": 1, "ctr1": 2, "ctr2": 3}
    assert driver.read(0.0).encoder_count == (1, 2, 3)
    driver.write(MOVING)
    assert not card.lines["port0/line5"]
    card.motion["ctr0"] = 4
    assert driver.read(0.001).encoder_count == (4, 2, 3)


def test_card_without_single_point_is_not_hardware_timed(bench: Bench, card: Card) -> None:
    card.single_point = False
    driver = bench(SYNC)
    driver.open()
    assert not driver.hardware_timed
    assert driver.read(0.0).encoder_valid == (True, True, True)


def test_sync_line_without_wire_is_refused_at_open(bench: Bench, card: Card) -> None:
    card.wire = ""
    with pytest.raises(DriverError, match=r"ctr0 \(encoder of the shoulder\).*sync line; check its wire"):
        bench(SYNC).open()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (replace(FULL, device="Dev7"), r"found the devices Dev1, expected Dev7"),
        (replace(FULL, serial=1), r"found serial number 4711, expected 1"),
        (replace(FULL, counters=("ctr0", "ctr1", "ctr9")), r"not found: Dev1/ctr9 \(-\d+\)"),
        (replace(FULL, valves=("ao0", "ao1", "ao9")), r"not found: Dev1/ao9"),
        (replace(FULL, supply_pressure="ai77"), r"not found: Dev1/ai77"),
    ],
)
def test_open_settings_not_matching_card_are_refused(bench: Bench, settings: DaqSettings, says: str) -> None:
    with pytest.raises(DriverError, match=says):
        bench(settings).open()


def test_open_card_in_use_is_refused(bench: Bench, driver: DaqDriver) -> None:
    with pytest.raises(DriverError, match=r"watchdog|reserved"):
        bench().open()
    with pytest.raises(DriverError, match="already open"):
        driver.open()


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"counters": ("ctr0", "ctr0", "ctr1")}, "counters"),
        ({"valves": ("ao0", "ao1", "ao1")}, "valves"),
        ({"sync_line": "port0/line0"}, "inputs and outputs"),
        ({"chamber_pressures": ("ai1", "ai1", "", "", "", "")}, "chamber_pressures"),
        ({"supply_pressure": "ai1", "spool_positions": ("ai1", "", "")}, "spool_positions"),
        ({"centre": (0.0, 5.0, 5.0)}, "full stroke"),
        ({"watchdog_relay": "K1"}, "the line feeds the relay"),
        ({"watchdog_line": "port0/line6"}, "the line feeds the relay"),
        ({"pressure_at_zero": 2e5, "pressure_at_full_scale": 1e5}, "pressure"),
        ({"pressure_at_zero": 0.5e5}, "a cut cable"),
        ({"highest_pressure": 1.6e6}, "a short circuit"),
        ({"vent_feedback": ("port0/line3", "port0/line5")}, "inputs and outputs"),
    ],
)
def test_daq_settings_contradiction_is_refused(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        DaqSettings(**wrong)


@pytest.mark.parametrize("counts", [131_071, 2, 0, 2**29])
def test_counts_per_revolution_not_quadrature_is_refused(counts: int) -> None:
    with pytest.raises(DriverError, match="multiple of four"):
        DaqDriver(counts_per_revolution=counts)


def test_open_without_nidaqmx_package_names_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = builtins.__import__

    def without(name: str, *arguments: Any) -> Any:
        if name.split(".", maxsplit=1)[0] == "nidaqmx":
            raise ModuleNotFoundError(f"No module named {name!r}")
        return whole(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", without)
    driver = DaqDriver()
    with pytest.raises(DriverError, match=r'pip install "golfbench\[daq\]"'):
        driver.open()
    driver.make_passive()
    driver.close()


def test_open_without_ni_driver_names_download_site() -> None:
    """The real package, all of it: there is no NI driver where this test runs."""
    try:
        nidaqmx._library_interpreter.LibraryInterpreter()
    except nidaqmx.errors.DaqNotFoundError:
        pass
    else:
        pytest.skip("this machine has NI's driver")
    driver = DaqDriver()
    with pytest.raises(DriverError, match=r"found no NI-DAQmx driver.*ni\.com"):
        driver.open()
    driver.close()
