"""The whole bench over CANopen, daemon and nodes on the local bus: a bus that goes and comes back."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from bench.base.errors import ExitCode, Refused
from bench.base.lifecycle import Cause, Phase, State
from bench.commissioning.machine.inputs import OperatorIO, of_simulation
from bench.commissioning.machine.machine import MotionBounds, Segment
from bench.commissioning.machine.machine_process import live_robot
from bench.commissioning.swings.robot_swings import slowed
from bench.commissioning.swings.speed_ramp import bench_of
from bench.config import load_configuration
from bench.network.bench_service import DeviceStatus
from bench.network.client import BenchClient, CommandRefused
from bench.records.shot.recorded_shot import recorded_shot
from bench.records.telemetry.record_file import read_swing
from bench.simulation.simulated_bench import SeriesSwing
from bench.supervisor.ownership import take_bench
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base import PASSIVE, Command
from drivers.base.records import unpack_command
from drivers.base.shared_memory import SharedRecord
from drivers.can_bus import switch
from sim.exchange import PLANT_REPORT, REPORT_FILE
from tests.drivers.canopen.frame_classes import CLASSES
from tests.running_bench import BenchProcess, command_beside, played_nodes, running_bench, write_configuration
from tests.waiting import wait_until

pytestmark = [
    pytest.mark.live,
    pytest.mark.timeout(400),  # the first start compiles
]

Result = TypeVar("Result")
LOST_SAMPLE = 0.0025
"""Age of an encoder's sample beyond which one was lost, s."""
SLOW_MOVES = "[envelope]\nencoder_timeout = 0.04\nmax_tick_interval = 0.05\n"
"""Where nothing swings at full speed, stalls of this machine may last longer."""


def device_when(client: BenchClient, holds: Callable[[DeviceStatus], bool]) -> DeviceStatus:
    """Return the device status, which is updated once a second, as soon as `holds` is true of it."""
    deadline = time.monotonic() + 20.0
    while not holds(device := client.status()["device"]):
        assert time.monotonic() < deadline, device
        time.sleep(0.1)
    return device


def patient_configuration(folder: Path, name: str, text: str = "") -> Path:
    """Write the configuration of a bench over CANopen, patient with a busy machine; `text` is appended."""
    return write_configuration(
        folder,
        name,
        f'[driver]\nname = "canopen"\nwatchdog = 0.3\n[canopen]\ninterface = "local_socket"\n'
        f'channel = "{folder / "bus"}"\nsdo_timeout = 2.0\nheartbeat = 0.1\ninterlock_period = 0.1\n{text}',
    )


def test_canopen_bench_lost_bus_latches_fault_until_reset(tmp_path: Path) -> None:
    channel = tmp_path / "bus"
    file = patient_configuration(tmp_path, "bus", SLOW_MOVES)
    with (
        played_nodes(file, "--folder", str(tmp_path)),
        running_bench(file) as bench,
        bench.client.lease("test"),
    ):
        report, plant = np.zeros(1, PLANT_REPORT), SharedRecord.open(tmp_path / REPORT_FILE, PLANT_REPORT)

        def in_force() -> Command:
            plant.read(report)
            command: Command = unpack_command(report["node"]["applied"])
            a, b, c = (round(opening, 3) + 0.0 for opening in command.valve)
            return command._replace(valve=(a, b, c))

        bench.recover()
        switch(channel, on=False)
        bench.wait_until(lambda record: record["state"] == State.FAULT)
        wait_until(lambda: in_force() == PASSIVE, 20.0, in_force)
        with pytest.raises(CommandRefused):
            bench.client.reset()
        bench.wait_until(lambda record: record["state"] == State.ESTOP)  # nobody knows of the circuit
        assert bench.now()["cause"] == Cause.DEVICE_PASSIVE  # and that is not why it stands
        told = device_when(bench.client, lambda device: "canopen: channel" in device["fault"])
        assert told["counters"]["recoveries"] == 0
        switch(channel, on=True)
        time.sleep(1.0)
        assert bench.now()["state"] in (State.FAULT, State.ESTOP)  # back, it changes nothing
        bench.recover()
        counters = device_when(bench.client, lambda device: not device["fault"])["counters"]
        assert counters["recoveries"] == 1
        assert counters["frames"] == sum(counters[name] for name in CLASSES) > 0
        plant.close()


@pytest.mark.release
def test_canopen_bench_replaced_node_recovers_by_reset(tmp_path: Path) -> None:
    file = patient_configuration(tmp_path, "store", SLOW_MOVES)
    with ExitStack() as first:
        first.enter_context(played_nodes(file, "--io", "wago-750"))
        with running_bench(file) as bench, bench.client.lease("test"):
            bench.recover()
            first.close()  # the nodes lose their memory with their process, as replaced ones
            bench.wait_until(lambda record: record["state"] in (State.FAULT, State.ESTOP))
            with played_nodes(file, "--io", "wago-750"):
                bench.recover()
                counters = device_when(bench.client, lambda device: not device["fault"])["counters"]
                assert counters["recoveries"] == 1
                assert "froze" not in bench.log


def said(file: Path, *arguments: str) -> tuple[int, str]:
    """Return exit code and messages of a command."""
    with command_beside(file, *arguments) as process:
        _, told = process.communicate(timeout=300.0)
    return process.returncode, told


@pytest.mark.release
@pytest.mark.timeout(600)
def test_canopen_bench_changed_encoder_preset_is_refused_until_calibrated(tmp_path: Path) -> None:
    file = patient_configuration(tmp_path, "preset", SLOW_MOVES)
    calibrate = ("calibrate", "encoders", "--uncertainty-deg", "0.02", "--zero-counts", "0", "0", "0")
    with ExitStack() as first:
        first.enter_context(played_nodes(file))
        with running_bench(file, "--read-only"):
            assert said(file, *calibrate) == (0, "")
        with running_bench(file) as bench, bench.client.lease("test"):
            bench.recover()
            first.close()
            bench.wait_until(lambda record: record["state"] in (State.FAULT, State.ESTOP))
            with played_nodes(file, "--encoder", "preset-17"):
                with pytest.raises(CommandRefused):
                    bench.client.reset()
                told = device_when(bench.client, lambda device: "preset" in device["fault"])["fault"]
                assert "found preset 32768, offset 32768, expected the values at calibration enc" in told
                assert "preset 0, offset 0. Its zero may have moved" in told
                with pytest.raises(CommandRefused):
                    bench.client.home()
                assert bench.now()["state"] in (State.FAULT, State.ESTOP)
    with played_nodes(file, "--encoder", "preset-17"):
        code, told = said(file, "run")
        assert (code, "encoder of the shoulder: found preset 32768" in told) == (ExitCode.DEVICE, True)
        code, told = said(file, "nodes", "--scan")
        assert (code, "node 1, 2, 3 missing or refused" in told) == (ExitCode.REFUSED, True)
        with running_bench(file, "--read-only"):
            assert said(file, *calibrate) == (0, "")
        assert said(file, "nodes", "--scan")[0] == 0


def is_undisturbed(cycles: np.ndarray[Any, Any], rows: Any = slice(None)) -> bool:
    """Return whether no tick is missing, and in `rows` no sample of an encoder."""
    whole = np.all(np.diff(cycles["tick"]) == 1)
    return bool(whole and cycles["encoder_age"][rows].max() < LOST_SAMPLE)


def newest_swing(bench: BenchProcess, stored: int) -> tuple[np.ndarray[Any, Any], dict[str, Any]]:
    """Return the first record of a swing that came to the ball after the first `stored` records.

    A homing that a stall stopped is also stored, possibly late.
    """
    until = time.monotonic() + 30.0
    while True:
        for path in bench.records[stored:]:
            cycles, metadata = read_swing(path)
            if Phase.IMPACT in cycles["phase"]:
                return cycles, metadata
        assert time.monotonic() < until
        time.sleep(0.1)


def swing_undisturbed(bench: BenchProcess) -> tuple[np.ndarray[Any, Any], dict[str, Any]]:
    """Home, arm and swing; return the record.

    Again where a stall of this machine, which the bench names or which leaves its mark in the record,
    stopped or hid the swing.
    """
    deadline = time.monotonic() + 240.0
    while True:
        seen, stored = len(bench.log), len(bench.records)
        try:
            bench.recover()
            bench.take_address()
            bench.swing()
            bench.wait_phase(Phase.FOLLOW_THROUGH)
            bench.wait_until(lambda record: record["state"] == State.READY)
            cycles, metadata = newest_swing(bench, stored)
            down = np.isin(cycles["phase"], (Phase.DOWNSWING, Phase.COMMITTED, Phase.IMPACT))
            if is_undisturbed(cycles, down) or time.monotonic() > deadline:
                return cycles, metadata
        except (Refused, TimeoutError):
            new = bench.log[seen:]
            stalled = "a stall of this machine" in new or Cause.TICK_GAP.name in new
            if not stalled or time.monotonic() > deadline:
                raise


@pytest.mark.release
@pytest.mark.timeout(600)
def test_canopen_bench_preconfigured_devices_home_and_swing(tmp_path: Path) -> None:
    """Encoders reversed and scaled, inputs and outputs inverted; a scan during the bench's run."""
    file = patient_configuration(tmp_path, "sold")
    with (
        played_nodes(file, "--encoder", "reversed-17", "--io", "inverted-io"),
        running_bench(file) as bench,
        bench.client.lease("test", 60.0),
    ):
        assert said(file, "nodes", "--scan")[0] == 0
        assert bench.client.status()["device"]["fault"] == ""
        cycles, metadata = swing_undisturbed(bench)
    speed = recorded_shot(cycles, metadata, "").record.shot.club_speed_mps
    assert speed is not None
    assert 40.0 < speed < 46.0


@pytest.mark.release
@pytest.mark.timeout(600)
def test_live_robot_over_canopen_moves_and_swings(tmp_path: Path) -> None:
    """It is measured at the pressure to which its regulator is turned, homed, armed and swung."""
    file = patient_configuration(tmp_path, "day", SLOW_MOVES)
    configuration = load_configuration(file)
    slow = slowed(load_profile(find_profile("default")), 0.5, configuration)
    bounds = MotionBounds((10.0, 10.0, 20.0), (3.0, 3.0, 5.0), 9e5)

    def resumed(do: Callable[[], Result]) -> Result:
        """Return the answer to `do`, which is repeated as --resume does while a stall ends it."""
        for _ in range(5):
            with suppress(Refused):
                return do()
        return do()

    with (
        played_nodes(file, "--folder", str(tmp_path)),
        take_bench(configuration.bench.id) as owner,
        live_robot(configuration, owner, OperatorIO(of_simulation(tmp_path), print)) as robot,
    ):
        robot.set_supply(3.0e5)
        trace = resumed(lambda: robot.run((Segment(2.0, (0.1, 0.0, 0.0), vents_shut=True),), bounds))
        assert not trace.tripped
        assert trace.supply[-1] == pytest.approx(3.0e5, rel=0.03)
        assert np.ptp(trace.pressure[:, 0]) > 0.5e5
        robot.set_supply(float("inf"))
        resumed(robot.vent)

        def swing() -> SeriesSwing:
            return resumed(lambda: robot.series(bench_of(configuration, slow)).swing(slow, ball=False))

        made = swing()
        for _ in range(2):  # a stall that makes a pressure too old stops a swing, too
            if made.cause is not Cause.NONE and not is_undisturbed(made.cycles):
                made = swing()
        assert made.cause is Cause.NONE
        robot.make_passive()
