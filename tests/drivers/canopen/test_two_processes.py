"""Driver and nodes as separate processes on the local bus: deaths, hangs, a lost bus, and the valves."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from bench.supervisor.child_process import Child, NotStarted
from drivers.base import PASSIVE, Command, DriverError
from drivers.can_bus import switch
from drivers.canopen.driver import CanopenDriver
from sim.exchange import REPORT_FILE, SURROUNDINGS_FILE, SurroundingsWriter
from sim.nodes.wall_plant import NodesPlan
from sim.plant import PlantParameters
from tests.drivers.canopen.nodes_process import NodesProcess
from tests.ready_child import ready_child
from tests.waiting import wait_until

pytestmark = pytest.mark.live

MOVING = Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True)
LONGEST = 20.0
"""s that a test waits for what takes milliseconds."""

LOOP = """
import sys, time
from drivers.base import Command
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.settings import CanopenSettings
driver = CanopenDriver(CanopenSettings("local_socket", sys.argv[1], sdo_timeout=2.0))
driver.open()
print("open", flush=True)
while True:
    driver.read(time.monotonic())
    driver.write(Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True))
    time.sleep(0.0005)
"""


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodesProcess]:
    made = NodesProcess(tmp_path_factory.mktemp("nodes"))
    yield made
    made.end()


@pytest.fixture
def driver(nodes: NodesProcess) -> Iterator[CanopenDriver]:
    made = CanopenDriver(nodes.settings, watchdog=0.3)
    made.open()
    yield made
    made.close()


def run(driver: CanopenDriver, holds: Callable[[], bool], command: Command = MOVING) -> None:
    """Run ticks until something holds."""
    deadline = time.monotonic() + LONGEST
    while not holds():
        assert time.monotonic() < deadline, driver.fault
        driver.read(time.monotonic())
        driver.write(command)
        time.sleep(0.0005)


def test_nodes_process_receives_commands_and_sends_positions(
    driver: CanopenDriver, nodes: NodesProcess
) -> None:
    run(driver, lambda: nodes.in_force == MOVING)
    run(driver, lambda: driver.counters.positions > 300 and driver.counters.analogue > 4)
    assert driver.operational
    assert nodes.node["operational"]


def test_surroundings_writer_changes_readings(driver: CanopenDriver, nodes: NodesProcess) -> None:
    with SurroundingsWriter(nodes.folder) as around:
        around.change(emergency_stop_clear=False, encoder_valid=(True, False, True))
        run(driver, lambda: not driver.read(time.monotonic()).emergency_stop_clear, PASSIVE)
        run(driver, lambda: not driver.read(time.monotonic()).encoder_valid[1], PASSIVE)
        around.change(emergency_stop_clear=True, encoder_valid=(True, True, True))
        run(driver, lambda: driver.read(time.monotonic()).emergency_stop_clear, PASSIVE)
        around.change(frozen=True)
        run(driver, lambda: driver.read(time.monotonic()).encoder_age[0] > 0.01, PASSIVE)
        around.change(frozen=False)
        run(driver, lambda: max(driver.read(time.monotonic()).encoder_age) < 0.0005, PASSIVE)
    assert driver.operational


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_loop_killed_or_frozen_valves_centre_within_watchdog(
    nodes: NodesProcess, number: signal.Signals
) -> None:
    before = int(nodes.node["watchdog_trips"])
    with subprocess.Popen(
        [sys.executable, "-c", LOOP, nodes.settings.channel],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    ) as loop:
        try:
            assert loop.stdout is not None
            assert loop.stdout.readline() == b"open\n"
            wait_until(lambda: nodes.in_force == MOVING)
            loop.send_signal(number)
            wait_until(lambda: nodes.in_force == PASSIVE)
        finally:
            loop.kill()
    wait_until(lambda: int(nodes.node["watchdog_trips"]) > before)
    node = nodes.node
    assert not node["operational"]
    # The plant's own ticks: 20 ms, and what a busy machine adds by making up ticks in bursts.
    assert 15 <= int(node["passive_tick"]) - int(node["command_tick"]) <= 40


def test_nodes_frozen_driver_latches_fault_until_reopened(driver: CanopenDriver, nodes: NodesProcess) -> None:
    run(driver, lambda: nodes.in_force == MOVING)
    nodes.child.process.send_signal(signal.SIGSTOP)
    try:
        run(driver, lambda: not driver.operational)
        assert "no heartbeat" in driver.fault or "interlocks" in driver.fault
    finally:
        nodes.child.process.send_signal(signal.SIGCONT)
    run(driver, lambda: nodes.in_force == PASSIVE)
    driver.close()
    driver.open()
    run(driver, lambda: nodes.in_force == MOVING)


def test_bus_switched_off_driver_latches_fault_until_reopened(
    driver: CanopenDriver, nodes: NodesProcess
) -> None:
    run(driver, lambda: nodes.in_force == MOVING)
    switch(nodes.settings.channel, on=False)
    try:
        run(driver, lambda: not driver.operational)
        assert "Network is down" in driver.fault
        wait_until(lambda: nodes.in_force == PASSIVE)
        driver.close()
        with pytest.raises(DriverError, match="check that the interface is up"):
            driver.open()
    finally:
        switch(nodes.settings.channel, on=True)
    driver.open()
    run(driver, lambda: nodes.in_force == MOVING)


def test_foreign_frames_are_tolerated_and_bus_off_faults(driver: CanopenDriver, nodes: NodesProcess) -> None:
    run(driver, lambda: nodes.in_force == MOVING)
    with can.Bus(interface="local_socket", channel=nodes.settings.channel) as other:
        before = driver.counters.positions
        for n in range(500):
            other.send(can.Message(arbitration_id=0x283, is_extended_id=False, data=[n & 0xFF]))
            other.send(can.Message(arbitration_id=0x555, is_extended_id=False, data=bytes(8)))
        run(driver, lambda: driver.counters.positions > before + 30)
        assert driver.counters.wrong_length > 0
        assert driver.operational, driver.fault
        other.send(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, data=bytes(8)))
        run(driver, lambda: driver.counters.bus_off == 1)
        assert "bus-off" in driver.fault
        run(driver, lambda: nodes.in_force == PASSIVE)


def nodes_in(folder: Path) -> Child:
    plan = NodesPlan("virtual", folder.name, 125_000, (1, 2, 3), 10, PlantParameters(), folder)
    return ready_child("sim.nodes.process", plan)


def test_nodes_process_successor_ends_first_and_cleans_folder(tmp_path: Path) -> None:
    first = nodes_in(tmp_path)
    last = nodes_in(tmp_path)
    try:
        assert first.process.wait(LONGEST) == 0
        assert set(os.listdir(tmp_path)) == {REPORT_FILE, SURROUNDINGS_FILE}
        last.process.send_signal(signal.SIGINT)  # the terminal's Ctrl-C is not for them
        last.process.terminate()
        assert last.process.wait(LONGEST) == 0
        assert last.take_events()[-1]["event"] == "stopped"
        assert os.listdir(tmp_path) == []
    finally:
        first.kill()
        last.kill()


def test_nodes_process_unknown_interface_reports_reason(tmp_path: Path) -> None:
    plan = NodesPlan("no_such", "x", 125_000, (1, 2, 3), 10, PlantParameters(), tmp_path)
    with pytest.raises(NotStarted, match="no_such"):
        ready_child("sim.nodes.process", plan)
