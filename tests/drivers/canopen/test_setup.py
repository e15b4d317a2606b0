"""The start-up: objects set and read back, and every refusal with node, object, abort code and action."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import pytest
from canopen.objectdictionary.datatypes import UNSIGNED8, UNSIGNED32

from drivers.base import PASSIVE, DriverError
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.frames import bus_load, max_rate, traffic, worst_bits
from drivers.canopen.settings import CanopenSettings, EncoderSettings, ValveNodeSettings
from sim.nodes._device import CanopenDevice
from sim.nodes.personality import ObjectChange, Personality
from tests.drivers.canopen.in_step import SETTINGS, WITH_SPOOLS, DriverInStep, Wire, make, nodes_plan
from tests.sampling import release_except

RELAY = replace(SETTINGS.valve_node, watchdog_relay="K7")


def without(device: Callable[[Wire], CanopenDevice], *objects: tuple[int, int]) -> Callable[[Wire], None]:
    """Return what takes objects out of a device."""

    def do(wire: Wire) -> None:
        for index, subindex in objects:
            del device(wire)._objects[index, subindex]
            if not any(i == index for i, _ in device(wire)._objects):
                del device(wire).object_dictionary[index]

    return do


def valve_node(wire: Wire) -> CanopenDevice:
    return wire.nodes.valve_node


def arm(wire: Wire) -> CanopenDevice:
    return wire.nodes.encoders[1]


def changed(device: Callable[[Wire], CanopenDevice], index: int, value: int) -> Callable[[Wire], None]:
    return lambda wire: device(wire).put(index, 0, value)


def unmappable(wire: Wire) -> None:
    wire.nodes.valve_node._objects[0x6411, 2].pdo_mappable = False


def fixed(wire: Wire) -> None:
    wire.nodes.valve_node._objects[0x6444, 3].access_type = "ro"


def forgetful(wire: Wire) -> None:
    """Take every error value and keep another one."""
    device, take = wire.nodes.valve_node, wire.nodes.valve_node.set_data

    def set_data(index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        take(index, subindex, b"\0\0\0\0" if index == 0x6444 else data, check_writable)

    device.set_data = set_data  # type: ignore[method-assign]


def silent(number: int) -> Callable[[Wire], None]:
    def do(wire: Wire) -> None:
        wire.meddle = lambda identifier, data: [] if identifier & 0x7F == number else [(identifier, data)]

    return do


def dropping(*identifiers: int) -> Callable[[Wire], None]:
    def do(wire: Wire) -> None:
        wire.meddle = lambda identifier, data: [] if identifier in identifiers else [(identifier, data)]

    return do


REFUSALS: dict[str, tuple[CanopenSettings, Callable[[Wire], None], str]] = {
    "no such node": (
        SETTINGS,
        silent(2),
        r"node 2 \(encoder of the arm\), object 1000h:0 .* no answer within 0.1 s; check",
    ),
    "another kind of device": (
        SETTINGS,
        changed(arm, 0x1000, 0x000F0191),
        r"node 2 .* object 1000h:0 \(device type\): found 0xf0191, expected 0x196; .* profile 406",
    ),
    "another vendor": (
        replace(SETTINGS, encoders=EncoderSettings(vendor=0x56)),
        lambda wire: None,
        r"node 1 .* object 1018h:1 \(vendor\): found 0xffffff01, expected 0x56; another device",
    ),
    "another product": (
        replace(SETTINGS, valve_node=ValveNodeSettings(product=7)),
        lambda wire: None,
        r"node 10 .* object 1018h:2 \(product\): found 0x191, expected 0x7",
    ),
    "another resolution": (
        SETTINGS,
        changed(arm, 0x6501, 4096),
        r"node 2 .* object 6501h:0 .*: found 4096, expected 131072; set plant.encoders.* = 4096",
    ),
    "no error value": (
        SETTINGS,
        without(valve_node, *((0x6444, n) for n in range(4))),
        r"node 10 .* object 6444h:1 \(error value of the valve of the shoulder vane\).* 06020000h.*"
        r"0 V is full stroke.*watchdog_relay",
    ),
    "an error value that is fixed": (
        SETTINGS,
        fixed,
        r"object 6444h:3 .* wrist cylinder\).* 06010002h.*set it at the device",
    ),
    "an error value that is not kept": (
        SETTINGS,
        forgetful,
        r"object 6444h:1 .*: found 0x0, expected 0x40000000; use a device that keeps",
    ),
    "no watchdog at all": (
        SETTINGS,
        without(valve_node, (0x1400, 5), (0x1016, 0), (0x1016, 1), (0x1016, 2)),
        r"node 10 .* neither object 1400h:5 .* nor 1016h:1 .*watchdog_relay",
    ),
    "an output that cannot be in a PDO": (
        SETTINGS,
        unmappable,
        r"node 10 .* object 1600h:2 .* abort code 06040041h, .*cannot map this object",
    ),
    "inputs without a timer": (
        SETTINGS,
        without(valve_node, (0x1800, 5)),
        r"node 10 .* object 1800h:5 .*broken line",
    ),
    "an encoder deaf for SYNC": (
        SETTINGS,
        changed(arm, 0x1005, 0x81),
        r"node 2 .* object 6004h in TPDO2: found no answer to SYNC",
    ),
    "a node that does not start": (
        SETTINGS,
        dropping(0x703),
        r"node 3 .* heartbeat: found no heartbeat within 0.25 s .* expected 5",
    ),
    "no such object": (
        replace(SETTINGS, encoders=EncoderSettings(position=0x6104)),
        lambda wire: None,
        r"node 1 .* object 6104h:0 \(position\).* abort code 06020000h, .*; the device has no such",
    ),
}


@pytest.mark.parametrize("refusal", REFUSALS.values(), ids=REFUSALS)
def test_setup_unfit_node_refusal_names_object(
    refusal: tuple[CanopenSettings, Callable[[Wire], None], str],
) -> None:
    settings, spoil, told = refusal
    driver, wire = make(settings)
    spoil(wire)
    with pytest.raises(DriverError) as raised:
        driver.open()
    assert re.search(told, str(raised.value), re.S), str(raised.value)
    assert not wire.open
    assert not driver.operational
    assert wire.in_force.supply_enable is False


@pytest.mark.parametrize(
    "spoil",
    [
        without(valve_node, *((0x6444, n) for n in range(4))),
        without(valve_node, (0x1400, 5), (0x1016, 0), (0x1016, 1), (0x1016, 2)),
    ],
    ids=["no error value", "no watchdog"],
)
def test_setup_watchdog_relay_replaces_missing_fallback(spoil: Callable[[Wire], None]) -> None:
    driver, wire = make(replace(SETTINGS, valve_node=RELAY))
    spoil(wire)
    wire.nodes.valve_node.fall_back = lambda: None  # type: ignore[method-assign]
    driver.open()
    assert driver.operational


def test_setup_with_watchdog_relay_sets_outputs_before_start() -> None:
    driver, wire = make(replace(SETTINGS, valve_node=RELAY))
    without(valve_node, *((index, n) for index in (0x6443, 0x6444) for n in range(4)))(wire)
    node, values = wire.nodes.valve_node, list[tuple[int, ...]]()
    places = [(0x6411, 1), (0x6411, 2), (0x6411, 3), (0x6200, 1), (0x6206, 1), (0x6207, 1), (0x1029, 1)]
    node.put(0x6200, 1, 0xFF)

    def note(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        if identifier == 0x581 and not values:  # the valve node comes before the encoders
            values.append(tuple(node.number_at(*location) for location in places))
        return [(identifier, data)]

    wire.meddle = note
    driver.open()
    assert values == [(16384, 16384, 16384, 0, 0xFF, 0, 0)]


@pytest.mark.parametrize("which", [(0x1800, 0x1A00), (0x1800, 0x1801, 0x1802, 0x1400, 0x1A00, 0x1600)])
def test_setup_fixed_correct_parameters_are_accepted(which: tuple[int, ...]) -> None:
    """A device that a predecessor has set up for this bench and then locked."""
    driver, wire = make()
    driver.open()
    driver.close()
    for (index, subindex), found in wire.nodes.valve_node._objects.items():
        if index in which and subindex != 5:
            found.access_type = "const"
    driver.open()
    assert driver.operational


def test_setup_fixed_wrong_identifier_is_refused() -> None:
    driver, wire = make()
    wire.nodes.valve_node._objects[0x1800, 1].access_type = "const"
    wire.nodes.valve_node._objects[0x1800, 1].default = 0x40000285
    with pytest.raises(DriverError, match=r"object 1800h:1 \(identifier of the PDO\).* 06010002h"):
        driver.open()


@pytest.mark.parametrize(
    "missing", [[(0x1400, 5)], [(0x1016, 0), (0x1016, 1), (0x1016, 2)]], ids=["heartbeat only", "timer only"]
)
def test_setup_single_watchdog_suffices_and_falls_back(missing: list[tuple[int, int]]) -> None:
    driver, wire = make()
    without(valve_node, *missing)(wire)
    driver.open()
    for k in range(30):
        driver.read(k * 0.001)
        driver.write(PASSIVE._replace(supply_enable=True))
    assert wire.in_force.supply_enable
    wire.pass_time(driver.watchdog + 0.002)
    assert wire.in_force == PASSIVE


def test_setup_writes_expected_objects() -> None:
    driver, wire = make()
    driver.open()
    node, encoder = wire.nodes.valve_node, wire.nodes.encoders[2]
    assert [node.number_at(0x6444, n) >> 16 for n in (1, 2, 3)] == [16384] * 3
    assert [node.number_at(0x6443, n) for n in (1, 2, 3)] == [1] * 3
    assert (node.number_at(0x6206, 1), node.number_at(0x6207, 1)) == (0xFF, 0)
    assert node.number_at(0x1400, 5) == 20
    assert node.number_at(0x1016, 1) == 127 << 16 | 20
    assert [node.number_at(0x1600, n) for n in range(5)] == [
        4,
        0x64110110,
        0x64110210,
        0x64110310,
        0x62000108,
    ]
    assert [node.number_at(0x1A01, n) >> 8 & 0xFF for n in range(1, 5)] == [1, 2, 3, 4]
    assert [node.number_at(0x1A02, n) >> 8 & 0xFF for n in range(1, 4)] == [5, 6, 7]
    assert node.number_at(0x1401, 1) & 0x80000000
    assert encoder.number_at(0x1800, 1) & 0x80000000
    assert encoder.number_at(0x1801, 1) & 0x7FF == 0x283
    assert (encoder.number_at(0x1801, 2), encoder.number_at(0x1017)) == (1, 50)
    assert {device.state for device in wire.nodes.devices} == {5}


def test_valve_node_power_loss_restarts_passive_and_faults() -> None:
    driver, wire = make()
    driver.open()
    driver.read(0.0)
    driver.write(PASSIVE._replace(valve=(1.0, 0.5, -1.0), supply_enable=True))
    wire.nodes.valve_node.boot(wire.now)
    assert wire.in_force == PASSIVE
    driver.read(0.001)
    assert "node 10 (valves and interlocks) has restarted" in driver.fault
    assert driver.write(PASSIVE._replace(supply_enable=True)) == PASSIVE


CODES = (0x06010000, 0x06010002, 0x06040041, 0x06040043, 0x06060000, 0x06090030, 0x08000000, 0x08000022)


def with_fixed_mapping(wire: Wire, code: int) -> None:
    node = wire.nodes.valve_node
    node.personality = Personality("fixed", "io", "any", "any", "CiA 301", fixed_mapping=code)


@pytest.mark.parametrize("code", release_except({CODES[0], CODES[-1]}, CODES), ids=hex)
def test_setup_fixed_matching_mapping_is_accepted(code: int) -> None:
    driver, wire = make()
    driver.open()  # leaves the mapping as it is needed
    driver.close()
    with_fixed_mapping(wire, code)
    driver.open()
    assert driver.operational


@pytest.mark.parametrize("code", release_except({CODES[0], CODES[-1]}, CODES), ids=hex)
def test_setup_fixed_wrong_mapping_refusal_names_abort_code(code: int) -> None:
    driver, wire = make()
    with_fixed_mapping(wire, code)
    told = rf"node 10 .* object 1600h:0 .*abort code {code:08X}h, .*fixed mapping, use one with a conf"
    with pytest.raises(DriverError, match=told):
        driver.open()


def test_setup_disables_pdos_beyond_first_four() -> None:
    objects = [
        ObjectChange(index + number, subindex, value, kind, "rw")
        for number in (2, 3, 4, 5)
        for index, subindex, value, kind in (
            (0x1400, 1, 0x20B if number == 5 else 0x80000000, UNSIGNED32),
            (0x1400, 2, 255, UNSIGNED8),
            (0x1600, 1, 0x62000108, UNSIGNED32),
        )
    ]
    many = Personality("many", "io", "any", "any", "CiA 301", objects=tuple(objects))
    wire = Wire(replace(nodes_plan(), io_personality=many))
    DriverInStep(wire, SETTINGS).open()
    assert wire.nodes.valve_node.number_at(0x1405, 1) & 0x80000000


def test_setup_stores_settings_only_when_changed() -> None:
    driver, wire = make()
    stores: list[int] = []
    keep = wire.nodes.valve_node._store

    def store(value: int) -> None:
        stores.append(value)
        keep(value)

    wire.nodes.valve_node._store = store  # type: ignore[method-assign]
    for _ in range(2):
        driver.open()
        driver.close()
    assert stores == [0x65766173]


def test_setup_node_without_store_or_error_behaviour_is_accepted() -> None:
    driver, wire = make()
    without(valve_node, (0x1010, 0), (0x1010, 1), (0x1029, 0), (0x1029, 1))(wire)
    driver.open()
    assert driver.operational


def test_setup_centre_off_5_volts_sets_error_values() -> None:
    driver, wire = make(
        replace(SETTINGS, valve_node=replace(SETTINGS.valve_node, centre=(4.9, 5.0, 5.1), span=4.8))
    )
    driver.open()
    found = [(wire.nodes.valve_node.number_at(0x6444, n) >> 16) / 3276.7 for n in (1, 2, 3)]
    assert found == pytest.approx([4.9, 5.0, 5.1], abs=2e-4)
    driver.read(0.0)
    driver.write(PASSIVE._replace(valve=(1.0, -1.0, 0.5)))
    assert wire.commands[-1][:3] == pytest.approx((9.7, 0.2, 7.5), abs=3e-4)


def test_setup_unfitted_pressures_are_not_requested() -> None:
    bare = replace(SETTINGS.valve_node, supply_pressure=0, chamber_pressures=(0,) * 6)
    driver, wire = make(replace(SETTINGS, valve_node=bare))
    driver.open()
    readings = [driver.read(k * 0.001) for k in range(30)][-1]
    assert math.isnan(readings.supply_pressure)
    assert driver.counters.analogue == 0
    assert wire.nodes.valve_node.number_at(0x1801, 1) & 0x80000000


def test_spool_positions_fitted_are_sent_with_each_sync() -> None:
    driver, wire = make(WITH_SPOOLS)
    driver.open()
    node = wire.nodes.valve_node
    assert [node.number_at(0x1803, n) & 0xFFFF for n in (1, 2)] == [0x480 + WITH_SPOOLS.valve_node.node, 1]
    assert [node.number_at(0x1A03, n) for n in range(4)] == [3, 0x64010810, 0x64010910, 0x64010A10]
    assert bus_load(WITH_SPOOLS, 0.001, 0.02) == pytest.approx(0.622, abs=0.005)


# Load ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("length", "bits"), [(0, 55), (4, 95), (6, 115), (8, 135)])
def test_worst_bits_includes_stuffing(length: int, bits: int) -> None:
    assert worst_bits(length) == bits


def test_bus_load_at_1_khz_and_1_mbit_matches_estimate() -> None:
    cyclic = [one.load for one in traffic(SETTINGS, 0.001, 0.02) if one.cycle == 0.001]
    assert sum(cyclic) / 1e6 == pytest.approx(0.465)  # 46 % in the estimate, which had one byte less
    assert bus_load(CanopenSettings(), 0.001, 0.02) == pytest.approx(0.507, abs=0.005)


def test_bus_load_above_limit_is_refused_before_open() -> None:
    settings = replace(SETTINGS, bitrate=500_000)
    driver = CanopenDriver(settings, open_bus=lambda *_: pytest.fail("opened"))
    with pytest.raises(
        DriverError, match=r"bus load 10\d% at 1000 Hz .* at most 75%; lower loop.rate to (\d+)"
    ) as raised:
        driver.open()
    rate = int(str(raised.value).split("lower loop.rate to ")[1].split()[0])
    assert 650 < rate < 750
    assert bus_load(settings, 1.0 / rate, 0.02) == pytest.approx(0.75, abs=0.002)
    assert max_rate(settings, 0.02) == pytest.approx(rate, abs=1.0)


# Interfaces ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("interface", "channel", "told"),
    [
        ("no_such", "x", r"interface 'no_such'.*set canopen.interface to one that python-can supports"),
        (
            "socketcan",
            "nocan7",
            r"interface 'socketcan', channel 'nocan7'.*ip link set nocan7 up type can bitrate",
        ),
    ],
)
def test_missing_can_interface_refusal_names_action(interface: str, channel: str, told: str) -> None:
    driver = CanopenDriver(CanopenSettings(interface=interface, channel=channel))
    with pytest.raises(DriverError, match=told):
        driver.open()
    driver.close()


@pytest.mark.parametrize(
    ("build", "told"),
    [
        (lambda: CanopenSettings(master=3), "node numbers"),
        (lambda: CanopenSettings(valve_node=ValveNodeSettings(valves=(1, 1, 2))), "valves"),
        (lambda: CanopenSettings(valve_node=ValveNodeSettings(supply_pressure=4)), "pressures"),
        (
            lambda: CanopenSettings(valve_node=ValveNodeSettings(spool_positions=(8, 9, 7))),
            "spool positions: different numbers",
        ),
        (lambda: CanopenSettings(valve_node=ValveNodeSettings(centre=(5.0, 5.2, 5.0))), "full stroke"),
    ],
)
def test_canopen_settings_contradiction_is_refused(build: Callable[[], CanopenSettings], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        build()
