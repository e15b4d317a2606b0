"""The DBC file against cantools: every frame that goes over the wire is described, and means the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cantools
import pytest
from cantools.database.can import Database
from typer.testing import CliRunner

from bench.commands.cli import app
from bench.commands.common import Session
from drivers.base import CHAMBERS, JOINTS, Command
from drivers.canopen.frames import dbc_text, traffic
from drivers.canopen.settings import CanopenSettings
from tests.drivers.canopen.in_step import PERIOD, SETTINGS, WITH_SPOOLS, make


def database(settings: CanopenSettings) -> Database:
    loaded = cantools.database.load_string(dbc_text(settings, PERIOD, 0.02), "dbc", strict=True)
    assert isinstance(loaded, Database)
    return loaded


@pytest.fixture(scope="module")
def described() -> Database:
    return database(SETTINGS)


def test_dbc_describes_every_frame_on_bus(described: Database) -> None:
    driver, wire = make()
    seen: dict[int, set[int]] = {}

    def note(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        seen.setdefault(identifier, set()).add(len(data))
        return [(identifier, data)]

    wire.meddle = note
    driver.open()
    for k in range(100):
        driver.read(k * PERIOD)
        driver.write(Command((0.1, 0.2, 0.3), beacon=True))
    driver.close()
    wire.order(129, 1)
    for identifier, data in wire.sent:
        seen.setdefault(identifier, set()).add(len(data))
    for identifier, lengths in seen.items():
        assert lengths == {described.get_message_by_frame_id(identifier).length}, hex(identifier)
    for one in traffic(SETTINGS, PERIOD, 0.02):
        assert one.identifier in seen or not one.cycle, one.name


def test_dbc_signals_have_limits(described: Database) -> None:
    for message in described.messages:
        for signal in message.signals:
            assert signal.minimum is not None, signal.name
            assert signal.maximum is not None, signal.name
            assert signal.minimum < signal.maximum
    command, pressures = (described.get_message_by_name(name) for name in ("COMMAND", "PRESSURES_1"))
    assert [(s.minimum, s.maximum) for s in command.signals[:4]] == [(0, 10)] * 3 + [(0, 1)]
    assert [(s.minimum, s.maximum) for s in pressures.signals] == [(0, 1.6e6)] * 4
    position = described.get_message_by_name("POSITION_ARM").signals[0]
    assert (position.minimum, position.maximum) == (0, 2**32 - 1)


def test_dbc_command_decodes_to_driver_command(described: Database) -> None:
    driver, wire = make()
    driver.open()
    driver.read(0.0)
    driver.write(Command((0.5, -1.0, 0.0), supply_enable=True, guard_lock=False, tee=True))
    frame = next(data for identifier, data in reversed(wire.sent) if identifier == 0x20A)
    decoded = described.decode_message("COMMAND", frame)
    assert isinstance(decoded, dict)
    assert decoded["valve_shoulder_vane"] == pytest.approx(7.5, abs=2e-4)
    assert decoded["valve_right_arm"] == 0.0
    assert decoded["valve_wrist_cylinder"] == pytest.approx(5.0, abs=2e-4)
    switches = ("supply_enable", "exhaust_closed", "guard_release", "beacon", "tee")
    assert [decoded[name] for name in switches] == [1, 0, 1, 0, 1]


def test_dbc_node_frames_decode_to_driver_readings(described: Database) -> None:
    driver, wire = make()
    heard: dict[int, bytes] = {}

    def note(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        heard[identifier] = data
        return [(identifier, data)]

    wire.meddle = note
    driver.open()
    wire.nodes.plant.state["guard_closed"] = True
    for k in range(29):
        driver.read(k * PERIOD)
        driver.write(Command(supply_enable=True, exhaust_closed=True))
    readings = driver.read(29 * PERIOD)
    values: dict[str, object] = {}
    for identifier, data in heard.items():
        decoded = described.decode_message(identifier, data)
        assert isinstance(decoded, dict)
        kind = described.get_message_by_frame_id(identifier).name
        values |= {f"{kind}.{name}": value for name, value in decoded.items()}
    for joint, count in zip(JOINTS, readings.encoder_count, strict=True):
        assert values[f"POSITION_{joint.upper()}.position"] == count
    for name in ("emergency_stop_clear", "guard_closed", "guard_locked", "local_reset", "ball_present"):
        assert bool(values[f"INPUTS.{name}"]) == getattr(readings, name)
    pressures = ("PRESSURES_1",) * 3 + ("PRESSURES_2",) * 3
    for frame, chamber, found in zip(pressures, CHAMBERS, readings.chamber_pressure, strict=True):
        assert values[f"{frame}.pressure_{chamber.lower().replace(' ', '_')}"] == pytest.approx(found)
    assert values["PRESSURES_1.pressure_supply"] == pytest.approx(readings.supply_pressure)
    assert str(values["HEARTBEAT_10.state"]) == "operational"


def test_dbc_follows_settings_of_valve_node() -> None:
    node = replace(SETTINGS.valve_node, node=40, supply_pressure=0, chamber_pressures=(3, 0, 0, 0, 0, 9))
    found = database(replace(SETTINGS, valve_node=node))
    assert found.get_message_by_name("COMMAND").frame_id == 0x228
    assert [s.name for s in found.get_message_by_name("PRESSURES_1").signals] == [
        "pressure_shoulder_vane_a",
        "pressure_wrist_cylinder_b",
    ]
    with pytest.raises(KeyError):
        found.get_message_by_name("PRESSURES_2")


def test_nodes_command_writes_dbc_file(tmp_path: Path) -> None:
    file = tmp_path / "bench.dbc"
    result = CliRunner().invoke(app, ["--config", "shipped", "nodes", "--dbc", str(file)], obj=Session())
    assert result.exit_code == 0, result.output
    assert len(cantools.database.load_file(file).messages) == 26  # type: ignore[union-attr]


def test_frames_with_spool_feedback_describe_positions() -> None:
    frame = database(WITH_SPOOLS).get_message_by_name("SPOOLS")
    assert (frame.frame_id, frame.cycle_time) == (0x48A, 1)
    decoded = frame.decode(b"\x00\x00\x00\x40\xff\x7f")
    assert isinstance(decoded, dict)
    names = ("spool_shoulder_vane", "spool_right_arm", "spool_wrist_cylinder")
    assert [decoded[name] for name in names] == pytest.approx([-1.0, 0.0, 1.0], abs=1e-4)
