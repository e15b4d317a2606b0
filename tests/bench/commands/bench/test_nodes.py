"""`golfbench nodes`: the devices of a configuration, played until Ctrl-C."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path

import pytest

from bench.base.errors import BenchError, ExitCode, Refused
from bench.commands.bench.simulators import _require_free, nodes_plan, show_scan, turn_regulator
from bench.config import load_configuration
from drivers.base.compiled import new_record
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.scan import ScannedNode
from drivers.registry import choose_driver, find_drivers
from sim.exchange import PLANT_SURROUNDINGS, PlantFiles
from tests.running_bench import command_beside

pytestmark = pytest.mark.live

LONGEST = 100.0
"""s; the first start compiles."""
OF_ROBOT = '[lifecycle]\nlocal_reset = true\n[loop]\nrealtime = "require"\n'
"""Keys that a real robot needs."""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "can.toml"
    path.write_text(
        f'base = "shipped"\n[driver]\nname = "canopen"\n[canopen]\ninterface = "local_socket"\n'
        f'channel = "{tmp_path / "bus"}"\nsdo_timeout = 2.0\n'
        "[canopen.encoders]\nnodes = [21, 22, 23]\n[canopen.valve_node]\nnode = 40\n"
    )
    return path


def test_nodes_serve_driver_until_ctrl_c(file: Path, tmp_path: Path) -> None:
    arguments = load_configuration(file).driver_arguments()
    driver = choose_driver("canopen", find_drivers())(**arguments)
    with command_beside(file, "nodes", "--folder", str(tmp_path)) as process:
        assert process.stderr is not None
        lines = iter(process.stderr.readline, "")
        assert any("nodes 21, 22, 23, 40 live on local_socket" in line for line in lines)
        assert (tmp_path / "plant-report").exists()
        driver.open()
        assert driver.operational
        driver.close()
        process.send_signal(signal.SIGINT)
        assert process.wait(LONGEST) == 0
    assert not (tmp_path / "plant-report").exists()
    assert list((tmp_path / "bus").iterdir()) == []


def test_nodes_unknown_interface_reports_action(file: Path) -> None:
    file.write_text(file.read_text().replace("local_socket", "no_such_interface") + OF_ROBOT)
    with command_beside(file, "nodes") as process:
        _, told = process.communicate(timeout=LONGEST)
    assert process.returncode == ExitCode.DEVICE
    assert "error: nodes on no_such_interface" in told
    assert "--config local_can" in told
    assert "Traceback" not in told


def test_nodes_scan_without_canopen_nodes_is_refused(file: Path) -> None:
    file.write_text(file.read_text().replace('"canopen"', '"sim"'))
    with pytest.raises(BenchError, match=r"driver\.name(?s:.)*'sim' has no CANopen nodes"):
        show_scan(load_configuration(file))


def test_nodes_numbers_in_use_are_refused(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text(file.read_text().replace("local_socket", "socketcan") + OF_ROBOT)
    there = ScannedNode(22, "encoder of the arm", "an encoder", "", True, "")
    silent = ScannedNode(40, "valves and interlocks", "", "", False, "no answer")
    monkeypatch.setattr("drivers.canopen.scan.scan", lambda *_: [there, silent])
    with pytest.raises(Refused, match="node 22 answers already"):
        _require_free(load_configuration(file))


def test_nodes_plan_matches_configuration(file: Path, tmp_path: Path) -> None:
    configuration = load_configuration(file)
    plan = nodes_plan(configuration, tmp_path)
    assert (plan.encoders, plan.valve_node, plan.interface) == ((21, 22, 23), 40, "local_socket")
    assert plan.plant == configuration.plant
    assert plan.priority == configuration.loop.priority - 1
    off = replace(configuration, loop=replace(configuration.loop, realtime="off"))
    assert nodes_plan(off, tmp_path).priority == 0


def test_driver_arguments_only_canopen_has_bus_settings(file: Path) -> None:
    configuration = load_configuration(file)
    arguments = configuration.driver_arguments()
    assert arguments["settings"] == configuration.canopen
    assert arguments["period"] == pytest.approx(0.001)
    assert isinstance(CanopenDriver(**arguments), CanopenDriver)
    sim = replace(configuration, driver=replace(configuration.driver, name="sim"))
    assert sim.driver_arguments() == {}


@pytest.mark.parametrize(
    ("text", "location", "told"),
    [
        ("bitrate = 500_000", "canopen.bitrate", "a bus load of 10"),
        ("sync_timeout = 0.0009", "canopen.sync_timeout", "0.0009 s"),
        ("sync_timeout = 0.0", "canopen.sync_timeout", "0.0"),
        ("master = 22", "canopen", "contradictory values"),
        ("bitrate = 2_000_000", "canopen.bitrate", "2000000"),
    ],
)
def test_load_configuration_invalid_bus_is_refused(file: Path, text: str, location: str, told: str) -> None:
    key = text.split(" = ", maxsplit=1)[0]
    kept = [line for line in file.read_text().splitlines() if not line.startswith(key)]
    kept.insert(kept.index("[canopen]") + 1, text)
    file.write_text("\n".join(kept))
    with pytest.raises(ExceptionGroup) as raised:
        load_configuration(file)
    (fault,) = raised.value.exceptions
    assert isinstance(fault, BenchError)
    assert fault.location == f"{file}: {location}"
    assert told in fault.found


def test_load_configuration_unused_slow_bus_is_accepted(file: Path) -> None:
    text = file.read_text().replace("[canopen]", "[canopen]\nbitrate = 500_000")
    file.write_text(text.replace('name = "canopen"', 'name = "sim"'))
    assert load_configuration(file).canopen.bitrate == 500_000


def test_turn_regulator_sets_regulated_pressure(tmp_path: Path) -> None:
    with PlantFiles(tmp_path) as files:
        for bar, regulated in (("1.3", 1.3e5), ("service", 0.0)):
            turn_regulator(tmp_path, bar)
            record = new_record(PLANT_SURROUNDINGS)
            assert files.surroundings.read(record)
            assert record["regulated"][0] == pytest.approx(regulated)


@pytest.mark.parametrize(
    ("folder", "bar", "said"),
    [
        ("there", "full", "bar absolute above 0"),
        ("there", "-1", "bar absolute above 0"),
        ("there", "nan", "bar absolute above 0"),
        ("nowhere", "3", "Start them with --folder"),
        (None, "3", "no --folder"),
    ],
)
def test_turn_regulator_invalid_request_is_refused(
    tmp_path: Path, folder: str | None, bar: str, said: str
) -> None:
    (tmp_path / "there").mkdir()
    with PlantFiles(tmp_path / "there") as files:
        with pytest.raises(Refused, match=said):
            turn_regulator(None if folder is None else tmp_path / folder, bar)
        assert not files.surroundings.read(new_record(PLANT_SURROUNDINGS))
