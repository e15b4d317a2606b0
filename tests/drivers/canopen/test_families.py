"""Device families as their makers' manuals describe them: each started against the driver."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.base import PASSIVE, Command, DriverError, Readings
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.settings import CanopenSettings
from sim.nodes.personality import ENCODER, IO, ObjectChange, Personality, find_personality, personalities
from tests.drivers.canopen.in_step import SETTINGS, DriverInStep, Wire, nodes_plan
from tests.sampling import release_except

ENCODERS = {name: one for name, one in personalities().items() if one.role == ENCODER}
NODES = {name: one for name, one in personalities().items() if one.role == IO}
NOT_THE_SHAFTS = {"siko-msa501", "temposonics-e", "preset-17", "ds406-v2"}
ROTARY = {name: one for name, one in ENCODERS.items() if name not in NOT_THE_SHAFTS}
TAKEN = {name: one for name, one in NODES.items() if name != "inverted-fixed"}
PLANT_COUNTS = 2**17


def bus(
    encoder: Personality | None = None,
    io: Personality | None = None,
    counts: int = PLANT_COUNTS,
    settings: CanopenSettings = SETTINGS,
) -> tuple[CanopenDriver, Wire]:
    wire = Wire(replace(nodes_plan(), encoder_personality=encoder, io_personality=io))
    return DriverInStep(wire, settings, counts), wire


def run(driver: CanopenDriver, command: Command = PASSIVE, ticks: int = 30) -> Readings:
    """Let the driver send `command` for some ticks; return the last readings."""
    readings = driver.read(0.0)
    for k in range(1, ticks):
        driver.write(command)
        readings = driver.read(k * 0.001)
    driver.write(command)
    return readings


def assert_counts_are_the_shafts(driver: CanopenDriver, wire: Wire, counts: int) -> None:
    """Every joint's count is the plant's, in the driver's resolution and direction."""
    readings = run(driver)
    assert readings.encoder_valid == (True, True, True)
    for found, true in zip(readings.encoder_count, wire.nodes.readings.encoder_count, strict=True):
        off = (found - true * counts // PLANT_COUNTS + counts // 2) % counts - counts // 2
        assert abs(off) <= 2 + counts // 4096


def test_personalities_cover_three_makers_per_role() -> None:
    makers = {role: set[str]() for role in (ENCODER, IO)}
    for one in personalities().values():
        assert len(one.source) > 20, one.name
        if one.maker != "any":
            makers[one.role].add(one.maker)
    assert len(makers[ENCODER]) >= 3
    assert len(makers[IO]) >= 3


@pytest.mark.parametrize("name", ROTARY)
def test_rotary_encoder_own_resolution_is_accepted(name: str) -> None:
    counts = ROTARY[name].counts or PLANT_COUNTS
    driver, wire = bus(encoder=ROTARY[name], counts=counts)
    driver.open()
    assert_counts_are_the_shafts(driver, wire, counts)


@pytest.mark.parametrize("name", [name for name, one in ROTARY.items() if one.counts])
def test_rotary_encoder_other_resolution_refusal_names_value(name: str) -> None:
    driver, _ = bus(encoder=ROTARY[name])
    counts = ROTARY[name].counts
    told = rf"node 1 .*6501h:0.*found {counts},.* expected 131072; set plant.* = {counts} if"
    with pytest.raises(DriverError, match=told):
        driver.open()


FINER = {
    "24 bit": (2**24, 1, False, 2**24),
    "24 bit, last position": (2**24, 1, True, 2**24),
    "25 bit": (2**25, 1, False, 2**24),
    "12 bit, 4096 turns": (2**12, 2**12, True, 2**12),
    "18 bit, 2^14 turns, 2^32 in all": (2**18, 2**14, False, 2**18),
    "18 bit, 2^14 turns, last position": (2**18, 2**14, True, 2**18),
    "no power of two": (360_000, 1, False, 360_000),
}
"""Counts of the disc, revolutions, whether 6002h is the last position, counts of the bench."""


@pytest.mark.parametrize("case", FINER.values(), ids=FINER)
def test_unknown_encoder_accepted_by_declared_resolution(case: tuple[int, int, bool, int]) -> None:
    disc, revolutions, is_last, counts = case
    plain = replace(ENCODERS["reversed-17"], counts=disc, revolutions=revolutions, range_is_last=is_last)
    objects = [ObjectChange(0x6000, 0, 4, None, None)] if disc != counts else []
    objects += [ObjectChange(index, 0, counts, None, None) for index in (0x6001, 0x6002) if disc != counts]
    driver, wire = bus(encoder=replace(plain, objects=tuple(objects)), counts=counts)
    driver.open()
    assert_counts_are_the_shafts(driver, wire, counts)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("siko-msa501", r"object 1000h:0 .*found encoder type 8, expected an absolute rotary encoder"),
        ("temposonics-e", r"object 6005h:1 .*found 20000, so the device counts lengths"),
    ],
)
def test_linear_encoder_is_refused(name: str, told: str) -> None:
    driver, _ = bus(encoder=ENCODERS[name])
    with pytest.raises(DriverError, match=told):
        driver.open()


@pytest.mark.parametrize("name", TAKEN)
def test_io_node_follows_commands_and_falls_back(name: str) -> None:
    driver, wire = bus(io=TAKEN[name])
    driver.open()
    command = PASSIVE._replace(valve=(0.5, -0.5, 1.0), supply_enable=True, exhaust_closed=True)
    readings = run(driver, command)
    assert driver.fault == ""
    assert wire.in_force._replace(valve=command.valve) == command
    assert wire.in_force.valve == pytest.approx(command.valve, abs=3e-4)
    assert readings.emergency_stop_clear == wire.nodes.readings.emergency_stop_clear
    assert readings.guard_closed == wire.nodes.readings.guard_closed
    wire.pass_time(driver.watchdog + 0.002)
    assert wire.in_force == PASSIVE


@pytest.mark.parametrize("name", TAKEN)
def test_io_node_power_loss_restarts_passive(name: str) -> None:
    driver, wire = bus(io=TAKEN[name])
    driver.open()
    driver.read(0.0)
    driver.write(PASSIVE._replace(valve=(1.0, 1.0, 1.0), supply_enable=True, exhaust_closed=True))
    wire.nodes.valve_node.boot(wire.now)
    assert wire.in_force == PASSIVE


def test_ds406_v2_encoder_with_position_pdo_is_accepted() -> None:
    old = ENCODERS["ds406-v2"]
    settings = replace(SETTINGS, encoders=replace(SETTINGS.encoders, position_pdo=0x1802))
    driver, wire = bus(encoder=old, counts=old.counts, settings=settings)
    driver.open()
    assert_counts_are_the_shafts(driver, wire, old.counts)


def test_ds406_v2_encoder_refusal_names_position_pdo_key() -> None:
    old = ENCODERS["ds406-v2"]
    driver, _ = bus(encoder=old, counts=old.counts)
    with pytest.raises(DriverError, match=r"object 1801h:1 .*set canopen\.encoders\.position_pdo .* 0x1802"):
        driver.open()


@pytest.mark.parametrize(
    "absent", [("6002",), ("6501",), ("6502",), ("6002", "6501", "6502", "6503", "6509")]
)
def test_encoder_without_describing_objects_is_accepted(absent: tuple[str, ...]) -> None:
    missing = frozenset((int(index, 16), None) for index in absent)
    driver, wire = bus(
        encoder=Personality("few", ENCODER, "any", "any", "", counts=2**14, absent=missing), counts=2**14
    )
    driver.open()
    assert_counts_are_the_shafts(driver, wire, 2**14)


@pytest.mark.parametrize("every", release_except({5}, [5, 1]))
@pytest.mark.parametrize("role", [ENCODER, IO])
def test_node_without_any_object_raises_only_driver_error(role: str, every: int) -> None:
    _, plain = bus()
    device = plain.nodes.valve_node if role == IO else plain.nodes.encoders[0]
    for index in list(device.object_dictionary)[::every]:
        lacking = Personality("lacking", role, "any", "any", "", absent=frozenset({(index, None)}))
        driver, _ = bus(encoder=lacking) if role == ENCODER else bus(io=lacking)
        with suppress(DriverError):
            driver.open()
            run(driver)


def test_store_parameters_beyond_store_time_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    driver, wire = bus(io=NODES["wago-750"])
    driver.open()
    assert 2.5 < wire.now < 3.0
    driver.close()
    driver, _ = bus(io=NODES["wago-750"], settings=SETTINGS)
    monkeypatch.setattr("drivers.canopen._setup.STORE_TIME", 2.0)
    with pytest.raises(DriverError, match=r"object 1010h:1 \(store parameters\).*no answer within 2 s"):
        driver.open()


def test_io_node_fixed_inverted_outputs_are_refused() -> None:
    driver, _ = bus(io=NODES["inverted-fixed"])
    told = r"object 6202h:1 \(polarity of the outputs\).*06010002h.*Found ffh: inverted.*own tool"
    with pytest.raises(DriverError, match=told):
        driver.open()


def test_io_node_unstorable_output_polarity_is_refused() -> None:
    inverted = NODES["inverted-io"]
    driver, _ = bus(io=replace(inverted, absent=frozenset({(0x1010, None)})))
    with pytest.raises(DriverError, match=r"6202h:1 .*inverted outputs, and the device cannot store"):
        driver.open()


@pytest.mark.parametrize("name", ["turck-bl20", "proface-htb", "wago-750"])
def test_io_node_error_value_has_device_size(name: str) -> None:
    driver, wire = bus(io=NODES[name])
    driver.open()
    node = wire.nodes.valve_node
    centre = 16384 if node.size_of(0x6444, 1) == 2 else 16384 << 16
    assert [node.number_at(0x6444, valve) for valve in (1, 2, 3)] == [centre] * 3


def test_io_node_error_behaviour_67feh_is_set() -> None:
    wago = NODES["wago-750"]
    objects = tuple(replace(one, value=1) if one.index == 0x67FE else one for one in wago.objects)
    driver, wire = bus(io=replace(wago, objects=objects))
    driver.open()
    assert wire.nodes.valve_node.number_at(0x67FE, 1) == 0


@pytest.mark.parametrize("name", ["posital-16", "wago-750"])
def test_find_personality_unknown_name_lists_choices(name: str) -> None:
    role = IO if name in ENCODERS else ENCODER
    with pytest.raises(ValueError, match=rf"{role} '{name}': not known; choose one of "):
        find_personality(name, role)


def test_manual_lists_every_family() -> None:
    text = (Path(__file__).parents[3] / "bench/manual/integrator/canopen.md").read_text(encoding="utf-8")
    rows = {line.split("|")[1].strip(" `"): line for line in text.splitlines() if line.startswith("| `")}
    refused = {"siko-msa501", "temposonics-e", "inverted-fixed"}
    for name, one in personalities().items():
        assert ("refused: " if name in refused else "taken") in rows[name], name
        assert not one.counts or f"| {one.counts} |" in rows[name]
