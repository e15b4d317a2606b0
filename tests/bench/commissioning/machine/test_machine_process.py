"""The robot itself under commissioning: sequences and swings in real time, in a separate process."""

from __future__ import annotations

import math
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.base.clock import FreeClock
from bench.base.errors import Refused
from bench.base.lifecycle import REFUSAL_TEXT, Cause, Refusal, Request, State
from bench.commissioning.machine._machine_server import LiveSeries, MachineServer
from bench.commissioning.machine.driver_machine import Stalled, StoppedByPerson
from bench.commissioning.machine.inputs import OperatorIO, of_simulation
from bench.commissioning.machine.machine import MotionBounds, MotionLog, Segment, Until
from bench.commissioning.machine.machine_process import (
    _PIECE,
    LiveRobot,
    MachineLost,
    _send,
    live_robot,
    with_quick_pressures,
)
from bench.commissioning.swings.robot_swings import slowed
from bench.commissioning.swings.speed_ramp import bench_of
from bench.config import Configuration
from bench.simulation.simulated_bench import ADDRESS_TRIES, ArmingFailed
from bench.simulation.swing_operator import SwingOperator
from bench.supervisor.ownership import take_bench
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from drivers.base import INVALID, PASSIVE, Command
from drivers.base.compiled import new_record
from drivers.base.records import READINGS
from drivers.canopen.frames import MAX_LOAD, bus_load
from sim.driver import PacedPlantDriver
from sim.exchange import SurroundingsWriter
from tests.compiled_only import needs_speed

pytestmark = pytest.mark.timeout(600)

BOUNDS = MotionBounds((10.0, 10.0, 20.0), (3.0, 3.0, 5.0), 9e5)
OPENING = (0.1, 0.0, 0.0)


class WatchedDriver(PacedPlantDriver):
    """Notes every command that it was given."""

    def __init__(self, folder: Path, configuration: Configuration) -> None:
        super().__init__(folder, configuration.plant)
        self.commands: list[Command] = []

    def write(self, command: Command) -> Command:
        self.commands.append(command)
        return super().write(command)

    def make_passive(self) -> None:
        self.commands.append(PASSIVE)
        super().make_passive()


def lose_encoders(
    driver: WatchedDriver, monkeypatch: pytest.MonkeyPatch, lost: Callable[[int], bool], first: int = 0
) -> list[int]:
    """Make all encoders invalid in the reads that are `lost`; return their number, from `first`."""
    original, reads = driver.read_record, [first]

    def read(at: float, record: np.ndarray) -> None:
        original(at, record)
        reads[0] += 1
        if lost(reads[0]):
            record["encoder_valid"] = 0

    monkeypatch.setattr(driver, "read_record", read)
    return reads


@pytest.fixture
def asked() -> list[bool]:
    """Return the stop requests; not empty: a stop is requested."""
    return []


@pytest.fixture
def driver(tmp_path: Path, configuration: Configuration) -> WatchedDriver:
    return WatchedDriver(tmp_path, configuration)


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def server(
    driver: WatchedDriver, configuration: Configuration, asked: list[bool], said: list[str]
) -> Iterator[MachineServer]:
    made = MachineServer(
        driver, configuration, FreeClock(configuration.plant.tick), stop=lambda: bool(asked), say=said.append
    )
    yield made
    made.close()
    assert driver.commands[-1] == PASSIVE


@pytest.fixture
def armed(server: MachineServer, configuration: Configuration, slow: Profile) -> MachineServer:
    server.obey("arm", bench_of(configuration, slow))
    return server


@pytest.fixture(scope="module")
def slow(configuration: Configuration) -> Profile:
    return slowed(load_profile(find_profile("default")), 0.6, configuration)


def test_machine_server_first_run_warns_with_beacon_before_supply(
    server: MachineServer, driver: WatchedDriver
) -> None:
    server.obey("run", (Segment(0.2, OPENING),), BOUNDS)
    with_air = next(n for n, command in enumerate(driver.commands) if command.supply_enable)
    warning = driver.commands[:with_air]
    assert sum(command.beacon for command in warning) == pytest.approx(2000, abs=1)
    assert all(command.valve == (0.0, 0.0, 0.0) for command in warning)
    driver.commands.clear()
    server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
    assert all(command.supply_enable for command in driver.commands), "no pause between two sequences"


def test_machine_server_hold_keeps_valve_commands(server: MachineServer, driver: WatchedDriver) -> None:
    server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
    for _ in range(50):
        server.hold()
    assert driver.commands[-1].valve == pytest.approx(OPENING)
    assert driver.commands[-1].supply_enable
    server.obey("make_passive")
    for _ in range(3):
        server.hold()
    assert driver.commands[-1] == PASSIVE


def test_machine_server_hold_over_bound_makes_passive(server: MachineServer, driver: WatchedDriver) -> None:
    tight = BOUNDS._replace(pressure=2.5e5)
    server.obey("run", (Segment(0.01, (0.3, 0.0, 0.0), vents_shut=True),), tight)
    assert driver.commands[-1].supply_enable
    for _ in range(3000):
        server.hold()
    assert driver.commands[-1] == PASSIVE
    with pytest.raises(Refused, match=r"bound 2\.50 bar"):
        server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
    server.obey("vent")
    server.obey("run", (Segment(0.1, OPENING),), BOUNDS)


@pytest.mark.parametrize(("clear", "closed"), [(False, True), (True, False)])
def test_machine_server_hold_open_interlock_makes_passive(
    server: MachineServer, driver: WatchedDriver, tmp_path: Path, clear: bool, closed: bool
) -> None:
    server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
    with SurroundingsWriter(tmp_path) as surroundings:
        surroundings.change(emergency_stop_clear=clear, guard_closed=closed)
        for _ in range(3):
            server.hold()
        assert driver.commands[-1] == PASSIVE
        with pytest.raises(Refused, match="--resume"):
            server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
        assert not driver.commands[-1].supply_enable
        surroundings.change(emergency_stop_clear=True, guard_closed=True)
    with pytest.raises(Refused, match="--resume"):  # the step begins again, at low pressure
        server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
    assert not driver.commands[-1].supply_enable
    server.obey("vent", 5.0)
    server.obey("run", (Segment(0.1, OPENING),), BOUNDS)


def test_machine_server_run_ignores_guard_opened_in_inputs_check(
    server: MachineServer, tmp_path: Path
) -> None:
    air = Command(supply_enable=True)
    with SurroundingsWriter(tmp_path) as surroundings:
        surroundings.change(guard_closed=False)
        server.obey("watch", air, None, math.inf, 0.01, 0.01)
        server.hold()
        surroundings.change(guard_closed=True)
        server.obey("watch", air, None, math.inf, 0.01, 0.01)
    server.obey("run", (Segment(0.1, OPENING),), BOUNDS)


def test_machine_server_hold_with_order_waiting_keeps_valve_commands(
    server: MachineServer, driver: WatchedDriver, asked: list[bool]
) -> None:
    server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
    asked.append(True)
    server.hold()
    assert driver.commands[-1].supply_enable


def test_machine_server_hold_tolerates_encoder_loss_of_five_ticks(
    server: MachineServer, driver: WatchedDriver, tmp_path: Path
) -> None:
    server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
    with SurroundingsWriter(tmp_path) as surroundings:
        for ticks, lasts in ((5, True), (6, False)):
            surroundings.change(encoder_valid=(True, False, True))
            for _ in range(ticks):
                server.hold()
            surroundings.change(encoder_valid=(True, True, True))
            server.hold()
            assert driver.commands[-1].supply_enable is lasts


def test_of_simulation_regulator_sets_supply_pressure(server: MachineServer, tmp_path: Path) -> None:
    turn = of_simulation(tmp_path)
    for pressure, expected in ((3.0e5, 3.0e5), (math.inf, 8.0e5)):
        turn(pressure)
        trace = server.obey("run", (Segment(3.0, (0.0, 0.0, 0.0), vents_shut=True),), BOUNDS)
        assert trace.supply[-1] == pytest.approx(expected, rel=0.05)


def test_machine_server_stop_in_run_makes_passive(
    server: MachineServer, driver: WatchedDriver, asked: list[bool]
) -> None:
    asked.append(True)
    with pytest.raises(Refused, match="stopped by the operator"):
        server.obey("run", (Segment(5.0, OPENING),), BOUNDS)
    assert driver.commands[-1] == PASSIVE
    asked.clear()
    server.obey("vent", 5.0)


def test_machine_server_swing_not_armed_raises(server: MachineServer, slow: Profile) -> None:
    with pytest.raises(ValueError, match="not armed"):
        server.obey("swing", slow, False)


@needs_speed
def test_machine_server_arms_and_swings_with_and_without_ball(
    server: MachineServer, driver: WatchedDriver, configuration: Configuration, slow: Profile
) -> None:
    server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
    server.obey("arm", bench_of(configuration, slow))
    for ball in (False, True):
        made = server.obey("swing", slow, ball)
        assert made.cause is Cause.NONE
        cycles = made.cycles
        assert len(cycles) == len(slow.angle)
        assert np.abs(cycles["angle"][slow.begins[5]] - slow.angle[slow.begins[5]]).max() < 0.3
        assert made.delivery is None, "the robot itself does not know"
    for _ in range(20):
        server.hold()
    server.obey("vent", 40.0)
    assert driver.commands[-1] == PASSIVE


@pytest.mark.slow
@needs_speed
def test_machine_server_arm_refused_briefly_is_repeated(
    server: MachineServer, configuration: Configuration, slow: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    request, refused = SwingOperator.request, list[int]()

    def refuse_first(operator: Any, which: int) -> bool:
        if which == Request.ARM and len(refused) < 3:
            refused.append(which)
            return False
        return request(operator, which)

    monkeypatch.setattr(SwingOperator, "request", refuse_first)
    server.obey("arm", bench_of(configuration, slow))
    assert len(refused) == 3
    assert server.obey("swing", slow, False).cause is Cause.NONE
    server.obey("vent", 40.0)


@needs_speed
def test_machine_server_arm_refused_reports_state_and_reason(
    server: MachineServer, configuration: Configuration, slow: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = SwingOperator.request

    def swing_unarmed(operator: Any, which: int) -> bool:
        return request(operator, Request.SWING if which == Request.ARM else which)

    monkeypatch.setattr(SwingOperator, "request", swing_unarmed)
    monkeypatch.setattr(LiveSeries._ask, "__defaults__", (0.5,))
    with pytest.raises(Refused) as refused:
        server.obey("arm", bench_of(configuration, slow))
    assert refused.value.found == "not possible in this state, READY"
    assert refused.value.action == "follow the text, then --resume."
    assert isinstance(refused.value, ArmingFailed)
    assert refused.value.cycles["state"][-1] == State.READY
    assert len(refused.value.cycles) > 500, "not only the last request"
    server.obey("vent", 40.0)


@needs_speed
def test_machine_server_release_guard_shuts_supply_until_lock_guard(
    armed: MachineServer,
    driver: WatchedDriver,
    slow: Profile,
    said: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("bench.commissioning.machine._machine_server._PERSON", 2.0)
    armed.obey("swing", slow, True)
    armed.obey("release_guard")
    inside = driver.commands[-1]
    assert (inside.guard_lock, inside.supply_enable, inside.valve) == (False, False, (0.0, 0.0, 0.0))
    with SurroundingsWriter(tmp_path) as surroundings:
        surroundings.change(guard_closed=False)
        for _ in range(100):
            armed.hold()
        with pytest.raises(Refused, match="guard"):
            armed.obey("lock_guard")
        assert not driver.commands[-1].supply_enable
        surroundings.change(guard_closed=True)
        armed.obey("lock_guard")
        assert armed.obey("swing", slow, True).cause is Cause.NONE
        armed.obey("release_guard")
        surroundings.change(guard_closed=False, emergency_stop_clear=False)
        for _ in range(100):
            armed.hold()
    assert [text for text in said if "Leave the robot" in text] == [
        "Leave the robot, leave the guard open (emergency stop circuit open)."
    ]


@needs_speed
def test_machine_server_release_guard_calls_person_to_gauges(
    armed: MachineServer, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    request, read = SwingOperator.request, list[int]()

    def refuse_until_read(operator: Any, which: int) -> bool:
        if which == Request.ACCESS and not read:
            read.append(which)
            operator.control["refusal"] = Refusal.GAUGE
            return False
        return request(operator, which)

    monkeypatch.setattr(SwingOperator, "request", refuse_until_read)
    armed.obey("release_guard")
    assert said == ["access: " + REFUSAL_TEXT[Refusal.GAUGE]]


@needs_speed
def test_machine_server_release_guard_after_early_press_calls_person_to_gauges(
    armed: MachineServer, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    request = SwingOperator.request

    def press_first(operator: Any, which: int) -> bool:
        if which == Request.ACCESS:
            operator.stepper.parameters.control["local_reset"] = True
            operator.control["venting"]["trapped"] = True
            operator.control["reset_pressed"] = operator.control["time"]
        return request(operator, which)

    monkeypatch.setattr(SwingOperator, "request", press_first)
    armed.obey("release_guard")
    assert said == ["access: " + REFUSAL_TEXT[Refusal.GAUGE]]


def test_live_robot_face_mark_waits_until_supply_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def order(robot: LiveRobot, which: str) -> None:
        done.append(which)

    def mark() -> tuple[float, float]:
        done.append("mark")
        return (1.0, 2.0)

    monkeypatch.setattr(LiveRobot, "_order", order)
    hands = OperatorIO(lambda pressure: None, person=mark, confirm=done.append)
    robot = LiveRobot(SimpleNamespace(), SimpleNamespace(), hands)  # type: ignore[arg-type]
    assert robot.face_mark(SimpleNamespace()) == (1.0, 2.0)  # type: ignore[arg-type]
    assert done[:3] == ["release_guard", "mark", "lock_guard"]
    assert [text.startswith("Unlock and open the supply") for text in done[3:]] == [True]


@needs_speed
def test_machine_server_stop_in_swing_is_refused(
    armed: MachineServer, slow: Profile, asked: list[bool]
) -> None:
    asked.append(True)
    with pytest.raises(Refused, match="stopped by the operator"):
        armed.obey("swing", slow, False)


@needs_speed
@pytest.mark.parametrize("guard", [False, True])
def test_machine_server_interlock_opened_in_swing_arms_only_by_new_command(
    armed: MachineServer,
    slow: Profile,
    driver: WatchedDriver,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    guard: bool,
) -> None:
    write, ticks = driver.write, [0]

    def interrupt(command: Command) -> Command:
        ticks[0] += 1
        if ticks[0] in (3_000, 8_000):
            with SurroundingsWriter(tmp_path) as surroundings:
                shut = ticks[0] == 8_000
                surroundings.change(emergency_stop_clear=shut or guard, guard_closed=shut or not guard)
        return write(command)

    monkeypatch.setattr(driver, "write", interrupt)
    with pytest.raises(StoppedByPerson, match="--resume"):
        armed.obey("swing", slow, False)
    assert not driver.commands[-1].supply_enable


@pytest.mark.slow
@needs_speed
def test_machine_server_swing_stopped_by_stall_is_repeated_and_reported(
    server: MachineServer,
    driver: WatchedDriver,
    configuration: Configuration,
    slow: Profile,
    said: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All encoders at once are lost when a machine stands still, not when a cable breaks."""
    reads = lose_encoders(driver, monkeypatch, lambda read: 300 <= read < 360, first=-(10**9))
    server.obey("arm", bench_of(configuration, slow))
    start = SwingOperator.start_swing

    def started_once(self: SwingOperator[Any], *given: int) -> bool:
        begun = start(self, *given)
        reads[0] = 0 if begun and not said else reads[0]
        return begun

    monkeypatch.setattr(SwingOperator, "start_swing", started_once)
    made = server.obey("swing", slow, False)
    assert made.cause is Cause.NONE
    repeated = next(text for text in said if "repeated" in text)
    assert "without a valid reading: all three encoders were lost at once" in repeated
    assert "stall of this machine" in repeated


@pytest.mark.slow
@needs_speed
def test_machine_server_arm_stopped_by_stall_is_repeated_and_reported(
    server: MachineServer,
    driver: WatchedDriver,
    configuration: Configuration,
    slow: Profile,
    said: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A device that went passive while this machine stood still is set to work again."""
    request, passive = SwingOperator.request, [False]

    def stalled(operator: Any, which: int) -> bool:
        if which == Request.ARM and not said:
            passive[0] = True
        return request(operator, which)

    def reopened() -> None:
        passive[0] = False

    monkeypatch.setattr(SwingOperator, "request", stalled)
    monkeypatch.setattr(driver, "fault", "the interlocks have not been received", raising=False)
    monkeypatch.setattr(WatchedDriver, "operational", property(lambda self: not passive[0]))
    monkeypatch.setattr(driver, "close", reopened)
    monkeypatch.setattr(driver, "open", reopened)
    server.obey("arm", bench_of(configuration, slow))
    assert len(said) == 1
    assert "the interlocks have not been received; it is armed again" in said[0]
    assert server.obey("swing", slow, False).cause is Cause.NONE
    server.obey("vent", 40.0)


@pytest.mark.slow
@needs_speed
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("stalls", "ends"), [(ADDRESS_TRIES + 1, False), (99, True)])
def test_machine_server_stalls_at_address_repeat_up_to_limit(
    server: MachineServer,
    driver: WatchedDriver,
    configuration: Configuration,
    slow: Profile,
    said: list[str],
    monkeypatch: pytest.MonkeyPatch,
    stalls: int,
    ends: bool,
) -> None:
    left, reads = [stalls], lose_encoders(driver, monkeypatch, lambda read: read < 60, first=99)
    start = SwingOperator.start_swing

    def stalled(self: SwingOperator[Any], *given: int) -> bool:
        if left[0]:
            left[0], reads[0] = left[0] - 1, 0
            self.advance(80)
        return start(self, *given)

    monkeypatch.setattr(SwingOperator, "start_swing", stalled)
    monkeypatch.setattr("bench.commissioning.machine._machine_server._REPEATED", ADDRESS_TRIES + 2)
    server.obey("arm", bench_of(configuration, slow))
    if ends:
        with pytest.raises(Refused, match=r"stopped at the address: .* all three encoders were lost at once"):
            server.obey("swing", slow, False)
    else:
        assert server.obey("swing", slow, False).cause is Cause.NONE
    assert sum("stopped at the address" in text for text in said) == ADDRESS_TRIES + 1


@needs_speed
def test_machine_server_stall_in_each_arming_ends_named_as_stall(
    server: MachineServer,
    driver: WatchedDriver,
    configuration: Configuration,
    slow: Profile,
    said: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lose_encoders(driver, monkeypatch, lambda read: read % 4000 > 3900)
    monkeypatch.setattr("bench.commissioning.machine._machine_server._REPEATED", 3)
    with pytest.raises(Stalled, match=r"arming, 3 times: .* all three encoders were lost at once"):
        server.obey("arm", bench_of(configuration, slow))
    assert sum("it is armed again" in text for text in said) == 2


@pytest.mark.slow
@needs_speed
def test_machine_server_swing_without_ball_is_refused(
    armed: MachineServer, slow: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LiveSeries, "_sees_ball", lambda self: False)
    with pytest.raises(Refused, match="Fill the feeder"):
        armed.obey("swing", slow, True)


# The process -----------------------------------------------------------------------------------------


@contextmanager
def started(configuration: Configuration, folder: Path) -> Iterator[LiveRobot]:
    bench = replace(configuration.bench, id=f"live-{os.getpid()}", data_dir=folder)
    ours = replace(configuration, bench=bench, loop=replace(configuration.loop, realtime="off"))
    with (
        take_bench(bench.id) as owner,
        live_robot(ours, owner, OperatorIO(of_simulation(owner.folder), lambda text: None)) as robot,
    ):
        yield robot


@pytest.mark.live
@pytest.mark.timeout(240)
def test_live_robot_runs_sequence_and_sigint_interrupts(tmp_path: Path, configuration: Configuration) -> None:
    with started(configuration, tmp_path) as robot:
        robot.set_supply(2.0e5)
        trace = robot.run((Segment(1.0, OPENING, vents_shut=True),), BOUNDS)
        assert not trace.tripped
        assert len(trace.time) == 1000
        assert trace.supply[-1] < 2.1e5
        assert robot.time == pytest.approx(1.0, abs=0.1)
        before = time.monotonic()
        threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            robot.run((Segment(50.0, OPENING),), BOUNDS)
        robot.make_passive()
        assert time.monotonic() - before < 20.0, "it does not wait for the end of the sequence"


@pytest.mark.live
@pytest.mark.timeout(240)
def test_live_robot_suspended_terminal_stops_process(tmp_path: Path, configuration: Configuration) -> None:
    """The watchdog of the valves then makes the machine passive."""
    with started(configuration, tmp_path) as robot:
        process = robot._child.pid
        state = Path(f"/proc/{process}/stat")
        os.kill(process, signal.SIGTSTP)
        deadline = time.monotonic() + 20.0
        while state.read_text().rpartition(") ")[2][0] != "T":
            assert time.monotonic() < deadline
            time.sleep(0.05)
        os.kill(process, signal.SIGCONT)
        robot.make_passive()


@pytest.mark.live
@pytest.mark.timeout(240)
def test_live_robot_killed_process_raises_machine_lost(tmp_path: Path, configuration: Configuration) -> None:
    with started(configuration, tmp_path) as robot:
        robot._child.kill()
        with pytest.raises(MachineLost, match="--resume"):
            robot.vent()
        robot.make_passive()


def test_send_unread_answer_continues_ticks() -> None:
    ours, theirs = Pipe()
    ticks: list[float] = []
    read: list[bytes] = []

    def read_all() -> None:
        read.extend(theirs.recv_bytes() for _ in range(theirs.recv()))

    reader = threading.Thread(target=read_all)

    def hold() -> None:
        ticks.append(time.monotonic())
        if len(ticks) == 100:
            reader.start()

    answer = bytes(2 << 20)
    with ours, theirs:
        pieces = len(pickle.dumps((7, True, answer))) // _PIECE + 1
        _send(ours, (7, True, answer), SimpleNamespace(hold=hold), lambda: False)  # type: ignore[arg-type]
        reader.join(10.0)
    assert b"".join(read) == pickle.dumps((7, True, answer))
    assert len(read) == pieces
    assert len(ticks) >= 100


# What a busy machine and a bus do to a record ----------------------------------------------------------


def test_log_missed_rows_and_invalid_pressures_are_interpolated() -> None:
    log = MotionLog(5, 1000)
    for n in (0, 1, 4, 5):
        readings = new_record(READINGS)
        readings["time"], readings["encoder_count"] = 7.0 + 0.001 * n, 10 * n
        readings["chamber_pressure"] = INVALID if n == 1 else n
        log.note(readings, Command(valve=(0.01 * n, 0.0, 0.0)), n // 4)
    trace = log.motion(None, (True,), 0.001).trace()
    assert trace.time == pytest.approx(7.0 + 0.001 * np.arange(6))
    assert trace.count[:, 0].tolist() == [0, 10, 20, 30, 40, 50]
    assert trace.pressure[:, 0] == pytest.approx(np.arange(6))
    assert trace.valve[:, 0] == pytest.approx([0.0, 0.01, 0.01, 0.01, 0.04, 0.05])
    assert trace.segment.tolist() == [0, 0, 0, 0, 1, 1]


def test_machine_server_pressure_lost_briefly_is_interpolated(
    server: MachineServer, driver: WatchedDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = [0]
    original = driver.read_record

    def read(at: float, record: np.ndarray) -> None:
        original(at, record)
        if lost[0]:
            lost[0] -= 1
            record["chamber_pressure"] = INVALID

    monkeypatch.setattr(server._machine, "_read_record", read)
    server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
    lost[0] = 5
    above = Until("above", 0, 9e5)
    trace = server.obey("run", (Segment(0.1, OPENING, until=above),), BOUNDS)
    assert not trace.tripped
    assert trace.ended == (False,), "an invalid pressure is above no level"
    assert np.isfinite(trace.pressure).all()
    lost[0] = 7
    with pytest.raises(Refused, match="no pressure of shoulder vane A"):
        server.obey("run", (Segment(0.1, OPENING),), BOUNDS)
    assert driver.commands[-1] == PASSIVE


def test_with_quick_pressures_canopen_limits_rate_to_bus_load(configuration: Configuration) -> None:
    assert with_quick_pressures(configuration) is configuration
    canopen = replace(configuration, driver=replace(configuration.driver, name="canopen"))
    assert with_quick_pressures(canopen).canopen.pressure_ticks == 2
    full = replace(canopen, canopen=replace(canopen.canopen, bitrate=800_000))
    ticks = with_quick_pressures(full).canopen.pressure_ticks
    assert 2 < ticks <= 10
    assert bus_load(replace(full.canopen, pressure_ticks=ticks), 0.001, 0.02) <= MAX_LOAD
