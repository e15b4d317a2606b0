"""The plant's process: loops die, freeze and come back, and the valves take notice."""

from __future__ import annotations

import os
import pickle
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bench.swing
from bench.control.settings import build_controller
from bench.loop.loop import Cycle, CycleArray
from bench.records.telemetry.cycle_record import CYCLE
from bench.supervisor.child import Child, NotStarted
from bench.swing.profile import load_profile
from drivers.base import PASSIVE, Command, DriverError
from drivers.base.records import unpack_command
from drivers.base.shared_record import SharedRecord
from sim.live.driver import ProcessPlantDriver
from sim.live.exchange import (
    COMMAND_FILE,
    PLANT_COMMAND,
    PLANT_REPORT,
    REPORT_FILE,
    SURROUNDINGS_FILE,
    PlantPlan,
)
from sim.live.surroundings import SurroundingsWriter
from sim.plant import PlantParameters
from tests.ready_child import ready_child

pytestmark = pytest.mark.live

PLANT = PlantParameters()
START = (0.2, 4.3, 6.0)
MOVING = Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True)
WATCHDOG = 0.02
WATCHDOG_TICKS = 20
LONGEST = 20.0
"""s that a test waits for what takes milliseconds."""

WRITER = """
import sys, time
from drivers.base import Command
from sim.live.driver import ProcessPlantDriver
driver = ProcessPlantDriver(sys.argv[1])
driver.open()
print("open", flush=True)
while True:
    driver.read(time.monotonic())
    driver.write(Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True))
    time.sleep(0.0005)
"""

STARTER = """
import os, pickle, sys
from tests.ready_child import ready_child
child = ready_child("sim.live.process", pickle.load(sys.stdin.buffer))
print(child.pid, flush=True)
os._exit(0)
"""


@contextmanager
def running(folder: Path, **changes: Any) -> Iterator[Child]:
    child = ready_child("sim.live.process", PlantPlan(folder, PLANT, WATCHDOG, START, **changes))
    try:
        yield child
    finally:
        with suppress(ProcessLookupError):
            child.process.send_signal(signal.SIGCONT)
        child.end(LONGEST)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("plant")


@pytest.fixture(scope="module", autouse=True)
def plant(folder: Path) -> Iterator[Child]:
    """Keep a plant running in `folder`."""
    with running(folder) as child:
        yield child


@pytest.fixture
def driver(folder: Path) -> Iterator[ProcessPlantDriver]:
    made = ProcessPlantDriver(folder)
    yield made
    made.close()


class Observer:
    """Reads the plant's report as anybody may."""

    def __init__(self, folder: Path) -> None:
        self._shared = SharedRecord.open(folder / REPORT_FILE, PLANT_REPORT)
        self._report = np.zeros(1, PLANT_REPORT)

    @property
    def report(self) -> Any:
        """The newest report."""
        self._shared.read(self._report)
        return self._report[0]

    def wait(self, holds: Callable[[Any], bool]) -> Any:
        """Return the first report seen of which `holds` is true."""
        deadline = time.monotonic() + LONGEST
        while not holds(self.report):
            assert time.monotonic() < deadline, f"never happened; last report: {self._report}"
            time.sleep(0.0005)
        return self._report[0]

    def pass_ticks(self, count: int) -> Any:
        """Wait until the plant lived through `count` more ticks."""
        last = int(self.report["ticks"]) + count
        return self.wait(lambda report: report["ticks"] >= last)

    def close(self) -> None:
        self._shared.close()


@pytest.fixture
def observer(folder: Path) -> Iterator[Observer]:
    made = Observer(folder)
    yield made
    made.close()


@pytest.fixture
def writer(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Be a loop of another process that drives the valves."""
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(folder)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    with process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"open\n"
            yield process
        finally:
            process.kill()


def is_moving(report: Any) -> bool:
    return bool(report["node"]["operational"] and report["node"]["applied"]["supply_enable"])


def applied(report: Any) -> Command:
    record = np.zeros(1, report["node"]["applied"].dtype)
    record[0] = report["node"]["applied"]
    return unpack_command(record)


def hold(driver: ProcessPlantDriver, observer: Observer) -> None:
    """Write until the command is in force."""
    deadline = time.monotonic() + LONGEST
    while not is_moving(observer.report):
        assert time.monotonic() < deadline
        driver.write(MOVING)
        time.sleep(0.0005)


def tripped(observer: Observer, trips: int) -> Any:
    """Wait for one more trip than `trips`; check that it came in the watchdog's time."""
    report = observer.wait(lambda r: r["node"]["watchdog_trips"] > trips)
    node = report["node"]
    assert (bool(node["operational"]), bool(node["passive_by_watchdog"])) == (False, True)
    assert applied(report) == PASSIVE
    silence = node["passive_tick"] - node["command_tick"]
    assert WATCHDOG_TICKS <= silence <= WATCHDOG_TICKS + 2
    return report


# A dead or frozen loop -------------------------------------------------------------------------------


def test_a_killed_loop_leaves_the_valves_passive(writer: subprocess.Popen[bytes], observer: Observer) -> None:
    trips = int(observer.wait(is_moving)["node"]["watchdog_trips"])
    writer.kill()
    tripped(observer, trips)
    report = observer.pass_ticks(50)
    assert applied(report) == PASSIVE


def test_a_frozen_loop_too_and_its_late_commands_revive_nothing_but_a_new_one_does(
    writer: subprocess.Popen[bytes], observer: Observer, driver: ProcessPlantDriver
) -> None:
    trips = int(observer.wait(is_moving)["node"]["watchdog_trips"])
    writer.send_signal(signal.SIGSTOP)
    counter = tripped(observer, trips)["node"]["counter"]
    writer.send_signal(signal.SIGCONT)
    report = observer.wait(lambda r: r["node"]["counter"] > counter + 10)  # it is heard …
    assert not report["node"]["operational"]  # … and not obeyed
    assert applied(report) == PASSIVE

    writer.kill()
    writer.wait()
    driver.open()
    assert not observer.report["node"]["passive_by_watchdog"]
    hold(driver, observer)


def test_a_killed_plant_is_old_readings_and_a_new_one_starts_passive(tmp_path: Path) -> None:
    driver = ProcessPlantDriver(tmp_path)
    with running(tmp_path) as child:
        driver.open()
        driver.write(MOVING)
        before = driver.read(time.monotonic())
        child.kill()
        driver.write(MOVING)
        after = driver.read(time.monotonic() + 1.0)
        assert after.encoder_age[0] >= 1.0
        assert after.encoder_time[0] <= before.encoder_time[0] + 1.0
        driver.make_passive()
        driver.close()
        assert {COMMAND_FILE, REPORT_FILE, SURROUNDINGS_FILE} == set(os.listdir(tmp_path))
    with running(tmp_path):
        driver.open()
        driver.read(time.monotonic())
        assert unpack_command(driver.report["node"]["applied"]) == PASSIVE
        assert driver.report["node"]["session"][0] == 1
        driver.close()
    assert os.listdir(tmp_path) == []


# What passes between them ----------------------------------------------------------------------------


def test_readings_carry_their_own_times(driver: ProcessPlantDriver, observer: Observer) -> None:
    driver.open()
    stamps = []
    for _ in range(100):
        now = time.monotonic()
        readings = driver.read(now)
        assert readings.time == now
        for stamp, age in zip(readings.encoder_time, readings.encoder_age, strict=True):
            assert age == now - stamp
            assert stamp <= time.monotonic()  # never from the future
        stamps.append(readings.encoder_time[0])
        observer.pass_ticks(1)
    assert np.all(np.diff(stamps) >= 0)
    assert len(set(stamps)) > 50
    ticks = (np.array(stamps) + PLANT.encoders.latency) / PLANT.tick
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-3)  # on the plant's grid


def test_a_plant_that_stalls_slips_and_does_not_hurry(
    plant: Child, driver: ProcessPlantDriver, observer: Observer
) -> None:
    driver.open()
    hold(driver, observer)
    before = observer.pass_ticks(1).copy()
    plant.process.send_signal(signal.SIGSTOP)
    try:
        last = float(observer.report["readings"]["time"])
        driver.read(time.monotonic())
        time.sleep(0.2)
        assert driver.read(time.monotonic()).encoder_age[0] >= 0.2
        driver.write(MOVING)
    finally:
        plant.process.send_signal(signal.SIGCONT)
    report = observer.wait(lambda r: r["readings"]["time"] > last + 0.1)
    assert report["plant_slips"] > before["plant_slips"]
    slipped = report["slipped_ticks"] - before["slipped_ticks"]
    assert slipped > 100
    passed = (report["readings"]["time"] - before["readings"]["time"]) / PLANT.tick
    assert report["ticks"] - before["ticks"] == round(passed) - slipped
    assert report["max_lateness"] >= 0.1


def test_the_surroundings_reach_the_loop(
    driver: ProcessPlantDriver, observer: Observer, folder: Path
) -> None:
    driver.open()
    assert driver.read(time.monotonic()).emergency_stop_clear
    with SurroundingsWriter(folder) as hands:
        hands.change(emergency_stop_clear=False, encoder_valid=(True, True, False))
        hands.place_ball()
    observer.pass_ticks(2)
    readings = driver.read(time.monotonic())
    assert not readings.emergency_stop_clear
    assert readings.guard_closed
    assert readings.encoder_valid == (True, True, False)
    assert readings.ball_present
    with SurroundingsWriter(folder) as hands:
        hands.change(frozen=True)
        observer.pass_ticks(2)
        first = driver.read(time.monotonic())
        observer.pass_ticks(20)
        second = driver.read(time.monotonic())
        assert second.encoder_time == first.encoder_time
        assert second.encoder_age[0] > first.encoder_age[0]
        hands.change(
            emergency_stop_clear=True, encoder_valid=(True, True, True), frozen=False, local_reset=True
        )
        hands.take_ball()
        observer.pass_ticks(2)
        readings = driver.read(time.monotonic())
        hands.change(local_reset=False)
    assert readings.emergency_stop_clear
    assert readings.local_reset
    assert not readings.ball_present
    assert all(readings.encoder_valid)


def test_garbage_in_its_records_does_not_stop_the_plant(
    driver: ProcessPlantDriver, observer: Observer, folder: Path
) -> None:
    random = np.random.default_rng(3)
    driver.open()
    hold(driver, observer)
    trips = int(observer.report["node"]["watchdog_trips"])
    records = SharedRecord.open(folder / COMMAND_FILE, PLANT_COMMAND)
    for _ in range(200):
        records.write(np.frombuffer(random.bytes(PLANT_COMMAND.itemsize), PLANT_COMMAND))
        time.sleep(0.0005)
    records.close()
    tripped(observer, trips)
    with (folder / COMMAND_FILE).open("r+b") as file:
        start = 64  # behind the header that tells what the file is
        file.seek(start)
        file.write(random.bytes((folder / COMMAND_FILE).stat().st_size - start))
    report = observer.pass_ticks(20)
    assert applied(report) == PASSIVE
    assert np.all(np.isfinite(report["truth"]["plant_angle"]))


def test_truth_goes_into_the_record_of_the_cycle(driver: ProcessPlantDriver, observer: Observer) -> None:
    cycle = np.zeros(1, CYCLE)
    driver.open()
    driver.read(time.monotonic())
    driver.note_truth(cycle)
    for name in CYCLE.names or ():
        if name.startswith("plant_"):
            assert cycle[name].tobytes() == driver.report["truth"][name].tobytes(), name
    assert cycle["plant_angle"][0, 1] > 3.0


# Opening ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hanging(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give a folder as a plant leaves it that does nothing any more."""
    folder = tmp_path_factory.mktemp("hanging")
    report = np.zeros(1, PLANT_REPORT)
    report["node"]["watchdog"] = WATCHDOG
    for name, dtype in ((COMMAND_FILE, PLANT_COMMAND), (REPORT_FILE, PLANT_REPORT)):
        shared = SharedRecord.create(folder / name, dtype)
        if name == REPORT_FILE:
            shared.write(report)
        shared.close()
    return folder


def test_a_plant_that_does_not_answer_is_refused(hanging: Path) -> None:
    driver = ProcessPlantDriver(hanging, timeout=0.05)
    for _ in range(2):
        with pytest.raises(DriverError, match=r"no answer to session 1 .*start it"):
            driver.open()
    driver.make_passive()
    with pytest.raises(DriverError, match=r"closed"):
        driver.read(0.0)


def test_no_plant_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DriverError, match=r"plant-report.*no such file"):
        ProcessPlantDriver(tmp_path).open()


def test_a_node_whose_watchdog_is_absent_or_too_long_is_refused(
    folder: Path, hanging: Path, tmp_path: Path
) -> None:
    driver = ProcessPlantDriver(folder, watchdog=0.0195)
    with pytest.raises(DriverError, match=r"watchdog: found 0.02 s, expected one of at most 0.0195 s"):
        driver.open()
    shutil.copytree(hanging, tmp_path / "none")
    shared = SharedRecord.open(tmp_path / "none" / REPORT_FILE, PLANT_REPORT)
    shared.write(np.zeros(1, PLANT_REPORT))
    shared.close()
    with pytest.raises(DriverError, match=r"watchdog: found none"):
        ProcessPlantDriver(tmp_path / "none").open()


# Start and end ---------------------------------------------------------------------------------------


@pytest.fixture
def memory() -> Iterator[Path]:
    """Give a folder in shared memory."""
    folder = Path(f"/dev/shm/golfbench-test-{os.getpid()}")  # noqa: S108 - private by its mode
    folder.mkdir(mode=0o700)
    yield folder
    folder.rmdir()  # fails when something is left in it


def test_it_ends_cleanly_and_leaves_nothing(memory: Path) -> None:
    with running(memory) as child:
        assert set(os.listdir(memory)) == {COMMAND_FILE, REPORT_FILE, SURROUNDINGS_FILE}
        child.process.send_signal(signal.SIGINT)  # the terminal's Ctrl-C is not for it
        observer = Observer(memory)
        observer.pass_ticks(50)
        observer.close()
        child.process.terminate()
        assert child.process.wait(LONGEST) == 0
        assert child.take_events() == [{"event": "stopped", "reason": "SIGTERM"}]


def test_it_ends_when_nobody_wants_it_any_more(tmp_path: Path) -> None:
    plan = PlantPlan(tmp_path, PLANT, WATCHDOG, START, orphan_timeout=0.3)
    starter = subprocess.run(
        [sys.executable, "-c", STARTER],
        input=pickle.dumps(plan),
        capture_output=True,
        check=True,
        timeout=100.0,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    number = int(starter.stdout)
    descriptor = os.pidfd_open(number)
    try:
        assert select.select([descriptor], [], [], LONGEST)[0], "the plant runs on"
        os.waitpid(number, 0)  # orphans of tests are adopted
    finally:
        os.close(descriptor)
    assert os.listdir(tmp_path) == []


def test_another_plant_in_its_folder_ends_it(tmp_path: Path) -> None:
    with running(tmp_path) as first, running(tmp_path):
        assert first.process.wait(LONGEST) == 0
        assert first.take_events()[-1]["event"] == "stopped"
        assert len(os.listdir(tmp_path)) == 3  # the second one's


def test_why_it_does_not_start_is_told(tmp_path: Path) -> None:
    cases = (tmp_path / "none", WATCHDOG, "Make the folder"), (tmp_path, 0.0, "watchdog")
    for folder, watchdog, told in cases:
        with pytest.raises(NotStarted) as failed:
            ready_child("sim.live.process", PlantPlan(folder, PLANT, watchdog))
        assert told in failed.value.found


# A loop around it ------------------------------------------------------------------------------------


def test_a_real_loop_runs_on_it(driver: ProcessPlantDriver) -> None:
    ticks = 1000
    kept = CycleArray(ticks)
    profile = load_profile(Path(bench.swing.__path__[0]) / "profiles" / "default.toml")
    parameters = build_controller(PLANT, profile)
    cycle = Cycle(driver, parameters, kept, name="plant", note_truth=driver.note_truth)
    driver.open()
    for _ in range(ticks):
        cycle.run_tick(time.monotonic())
        time.sleep(PLANT.tick)
    record = kept.cycles[-1]
    assert cycle.read_error is None
    assert cycle.publish_error is None
    assert np.all(record["encoder_valid"] == 1)
    np.testing.assert_allclose(record["angle"], record["plant_angle"], atol=0.01)
    assert driver.report["node"]["counter"][0] > ticks // 2
