"""The scan of a bus: it finds every node, reports as the startup would, and changes nothing."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bench.commands.cli import app
from bench.commands.common import Session
from drivers.base import PASSIVE, DriverError
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.scan import ScannedNode, scan
from drivers.canopen.settings import CanopenSettings
from sim.nodes.personality import ENCODER, IO, Personality, find_personality, personalities
from tests.drivers.canopen.in_step import SETTINGS, DriverInStep, Wire, nodes_plan, settings_of
from tests.sampling import release_except


def scanned(
    encoder: Personality | None = None,
    io: Personality | None = None,
    counts: int = 2**17,
    settings: CanopenSettings = SETTINGS,
) -> dict[int, ScannedNode]:
    wire = Wire(replace(nodes_plan(), encoder_personality=encoder, io_personality=io))
    before = [settings_of(device) for device in wire.nodes.devices]
    found = scan(settings, counts, clock=lambda: wire.now, open_bus=wire.opened)
    assert [settings_of(device) for device in wire.nodes.devices] == before
    assert {data[0] & 0xE0 for _, data in wire.sent} <= {0x40, 0x60}, "something else than reading"
    assert not wire.open
    return {node.number: node for node in found}


def test_scan_plain_nodes_are_accepted_unchanged() -> None:
    found = scanned()
    assert list(found) == [1, 2, 3, 10]
    assert all(node.taken and not node.verdict for node in found.values())
    assert found[2].role == "encoder of the arm"
    assert found[2].device.startswith("golfbench encoder, profile 406, vendor FFFFFF01h")
    assert found[2].properties == "131072 counts per revolution, single turn"
    assert "watched by 1400h:5 and 1016h:1, outputs fall back by 6206h" in found[10].properties


def test_scan_names_settings_of_startup() -> None:
    found = scanned(find_personality("reversed-17", ENCODER), find_personality("inverted-io", IO))
    assert found[1].properties.endswith("single turn, scaled to 4096 counts, reversed")
    assert found[1].verdict == (
        "after setting 6001h = 0x20000 (measuring units per revolution), 6002h = 0x20000 (total measuring "
        "range), 6000h = 0x0 (operating parameters)"
    )
    assert "6202h = 0x0 (polarity of the outputs)" in found[10].verdict


@pytest.mark.parametrize("name", [name for name, one in personalities().items() if one.role == ENCODER])
@pytest.mark.parametrize("counts", release_except({2**17}, [2**17, 2**16]))
def test_scan_verdict_matches_startup(name: str, counts: int) -> None:
    encoder = find_personality(name, ENCODER)
    wire = Wire(replace(nodes_plan(), encoder_personality=encoder))
    driver: CanopenDriver = DriverInStep(wire, SETTINGS, counts)
    verdict = scanned(encoder, counts=counts)[1]
    try:
        driver.open()
        refusal = ""
    except DriverError as error:
        refusal = str(error)
    assert verdict.taken is (refusal == "")
    if refusal:
        assert verdict.verdict == refusal


def test_scan_stopped_node_is_read_and_left_stopped() -> None:
    wire = Wire(nodes_plan())
    driver = DriverInStep(wire, SETTINGS)
    driver.open()
    driver.close()
    states = [device.state for device in wire.nodes.devices]
    assert sorted(states) == [4, 127, 127, 127]
    wire.sent.clear()
    found = scan(SETTINGS, 2**17, clock=lambda: wire.now, open_bus=wire.opened)
    assert [(node.number, node.taken) for node in found] == [(1, True), (2, True), (3, True), (10, True)]
    assert [device.state for device in wire.nodes.devices] == states
    assert [data for identifier, data in wire.sent if identifier == 0] == [b"\x80\x0a", b"\x02\x0a"]
    assert wire.in_force == PASSIVE


def test_scan_lists_missing_and_misnumbered_nodes() -> None:
    node = replace(SETTINGS.encoders, nodes=(1, 2, 10))
    settings = replace(SETTINGS, encoders=node, valve_node=replace(SETTINGS.valve_node, node=11))
    found = scanned(settings=settings)
    assert found[3].verdict == "in no role: correct the numbers in [canopen]"
    assert not found[10].taken
    assert "expected device profile 406" in found[10].verdict
    assert found[11].verdict.startswith("no answer; check its power")


@pytest.mark.parametrize(
    ("absent", "told"),
    [
        ((0x6444, None), r"object 6444h:1 .*06020000h.*0 V is full stroke.*watchdog_relay"),
        ((0x1800, 5), r"object 1800h:5 \(event timer of the inputs\)"),
        ((0x6206, None), r"found no error mode of the outputs"),
    ],
)
def test_scan_unfit_io_node_verdict_names_object(absent: tuple[int, int | None], told: str) -> None:
    io = replace(find_personality("inverted-io", IO), absent=frozenset({absent}))
    found = scanned(io=io)[10]
    assert not found.taken
    assert re.search(told, found.verdict), found.verdict


@pytest.mark.parametrize("role", [ENCODER, IO])
def test_scan_and_startup_refuse_node_without_heartbeat(role: str) -> None:
    """Older devices answer node guarding only."""
    number, family = (1, "reversed-17") if role == ENCODER else (10, "inverted-io")
    older = replace(find_personality(family, role), absent=frozenset({(0x1017, None)}))
    encoder, io = (older, None) if role == ENCODER else (None, older)
    plan = replace(nodes_plan(), encoder_personality=encoder, io_personality=io)
    found = scanned(encoder, io)[number]
    assert not found.taken
    assert "object 1017h:0 (heartbeat)" in found.verdict
    with pytest.raises(DriverError, match=rf"node {number} .*, object 1017h:0 \(heartbeat\)"):
        DriverInStep(Wire(plan), SETTINGS).open()


def test_nodes_command_empty_bus_fails_and_names_nodes(tmp_path: Path) -> None:
    file = tmp_path / "bench.toml"
    file.write_text(f'base = "local_can"\n[canopen]\nchannel = "{tmp_path}/bus"\nsdo_timeout = 0.05\n')
    result = CliRunner().invoke(app, ["--config", str(file), "nodes", "--scan"], obj=Session())
    assert result.exit_code != 0
    for number in (1, 2, 3, 10):
        assert f"node {number}: " in result.output
    assert "refused: no answer; check its power" in result.output


def test_nodes_command_unknown_family_lists_choices() -> None:
    result = CliRunner().invoke(app, ["--config", "local_can", "nodes", "--io", "posital-16"], obj=Session())
    assert result.exit_code != 0
    assert "wago-750" in f"{result.output}{result.exception}"


def stopped_by_a_bench() -> Wire:
    wire = Wire(nodes_plan())
    driver = DriverInStep(wire, SETTINGS)
    driver.open()
    driver.close()
    wire.sent.clear()
    return wire


def test_scan_lost_answer_is_requested_again() -> None:
    wire, lost = Wire(nodes_plan()), [0]

    def meddle(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        """Lose the first two answers of node 2, as a participant that the machine holds up does."""
        if identifier == 0x582 and lost[0] < 2:
            lost[0] += 1
            return []
        return [(identifier, data)]

    wire.meddle = meddle
    found = scan(SETTINGS, 2**17, clock=lambda: wire.now, open_bus=wire.opened)
    assert [(node.number, node.taken) for node in found] == [(1, True), (2, True), (3, True), (10, True)]


def test_scan_with_bench_on_bus_sends_no_nmt_command() -> None:
    wire = stopped_by_a_bench()
    wire.meddle = lambda identifier, data: [(0x77F, b"\x05"), (identifier, data)]
    found = scan(SETTINGS, 2**17, clock=lambda: wire.now, open_bus=wire.opened)
    assert [(node.number, node.taken) for node in found] == [(1, True), (2, True), (3, True), (10, False)]
    assert "stopped, while a bench is on this bus" in found[3].verdict
    assert not [data for identifier, data in wire.sent if identifier == 0]


def test_scan_node_started_by_bench_is_not_stopped() -> None:
    wire = stopped_by_a_bench()

    def meddle(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        """Let a bench start the node once its name is read."""
        if identifier == 0x58A and data[1:4] == b"\x08\x10\x00":
            wire.order(1, 10)
        return [(identifier, data)]

    wire.meddle = meddle
    scan(SETTINGS, 2**17, clock=lambda: wire.now, open_bus=wire.opened)
    assert [data for identifier, data in wire.sent if identifier == 0] == [b"\x80\x0a"]
    assert wire.nodes.valve_node.state == 5
