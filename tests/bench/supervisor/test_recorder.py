"""The recorder as its supervisor meets it, with a loop that only writes."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Cause, State
from bench.loop.snapshot import SNAPSHOT, read_snapshot
from bench.records.shot.recorded_shot import FlightConditions
from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.record_file import read_swing
from bench.records.telemetry.swing_metadata import read_profile, since
from bench.supervisor.child_process import CORRECTED, HEARTBEAT, Condition, RecorderPlan, pack_correction
from bench.supervisor.recorder import Recorder
from bench.swing.correction import basis_of
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.compiled import PLAIN
from drivers.base.shared_memory import SharedRecord
from tests.bench.supervisor.service_bench import Cycles, ServiceBench, ServiceProcess, run_below
from tests.waiting import HURRY, wait_until

pytestmark = pytest.mark.live

S = State
ONCE = [(S.READY, 300), (S.ARMED, 400), (S.SWINGING, 300), (S.RECOVERING, 200)]
SWING = [*ONCE, (S.READY, 400)]


RECORDER = "bench.supervisor.recorder"


class Bench(ServiceBench):
    """A loop that writes given cycles, and the recorder."""

    def __init__(self, folder: Path, capacity: int) -> None:
        super().__init__(folder, "recorder", capacity)
        self.data = folder / "data"
        self.snapshots = SharedRecord.create(folder / "snapshot", SNAPSHOT)
        self.corrected = SharedRecord.create(folder / "corrected", CORRECTED)

    def plan(self, **changes: Any) -> RecorderPlan:
        profile = load_profile(find_profile("default"))
        return RecorderPlan(
            **{
                "data_dir": self.data,
                "folder": self.folder,
                "snapshot_dtype": SNAPSHOT,
                "profile": profile,
                "basis": basis_of(profile),
                "run": {
                    "bench": "b1",
                    "run": "r",
                    "configuration": {"loop": {"rate": 1000}},
                    "versions": {"golfbench": "test"},
                    "real_time": {"scheduling": "FIFO"},
                    "calibrations": {"date": "2026-11-21"},
                },
                "around": FlightConditions(),
                "lead": 0.125,
                "tail": 0.25,
                **changes,
            }
        )

    @property
    def recorder(self) -> ServiceProcess:
        """The newest one."""
        return self.processes[-1]

    def start(self, **changes: Any) -> None:
        self.start_anyhow(**changes)
        assert self.event()["event"] == "ready"

    def start_anyhow(self, **changes: Any) -> None:
        self.kill()
        self.run("-m", RECORDER, plan=self.plan(**changes), **{PLAIN: "1"})

    def snapshot(self, tick: int) -> None:
        record = np.zeros(1, SNAPSHOT)
        record["tick"], record["time"] = tick, 0.5
        record["control"]["swings"] = 77
        self.snapshots.write(record)

    def correct(self, tick: int, number: int, weights: Sequence[float]) -> None:
        """Let the loop have taken a correction in `tick`."""
        record = np.zeros(1, CORRECTED)
        record["asked"], record["tick"], record["order"] = number, tick, pack_correction(number, weights)
        self.corrected.write(record)

    def event(self) -> dict[str, Any]:
        """Wait for the next event and return it."""
        return self.recorder.event()

    def read_up(self) -> None:
        """Wait until the recorder has taken in all that is written."""
        count = int(self.heartbeat()["count"])
        wait_until(lambda: self.heartbeat()["count"] > count + 3)  # a turn that stores beats twice

    def end(self) -> int:
        """Ask the recorder to end and return its exit code."""
        self.recorder.terminate()
        return self.recorder.wait(HURRY)

    def files(self) -> list[Path]:
        return sorted((self.data / "swings" / "b1").glob("*"))

    def close(self) -> None:
        super().close()
        self.snapshots.close()
        self.corrected.close()


@pytest.fixture
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Bench]:
    made = Bench(tmp_path, getattr(request, "param", 16384))
    yield made
    made.close()


MakeDay = Callable[..., Cycles]


@pytest.fixture
def day(make_day: MakeDay) -> Callable[..., Cycles]:
    """Return `day(plan, first_tick)` on the clock of this machine: it ended just now."""

    def make(plan: list[tuple[State, int]], first_tick: int = 1, **more: Any) -> Cycles:
        return make_day(plan, first_tick=first_tick, start=float(round(time.monotonic())), **more)

    return make


def stored_cycles(path: Path) -> tuple[bytes, dict[str, Any]]:
    """Return the cycles as the loop wrote them, and the metadata."""
    cycles, metadata = read_swing(path)
    return since(cycles, -metadata["begin"]).tobytes(), metadata


def test_recorder_swing_stores_one_complete_record(bench: Bench, day: MakeDay) -> None:
    cycles = day(SWING)
    bench.start()
    bench.snapshot(301)
    bench.write(cycles)
    told = bench.event()
    assert (told["event"], told["kind"], told["number"], told["replayable"]) == ("stored", "swing", 1, True)
    (path,) = bench.files()
    assert told["path"] == str(path)
    data, metadata = stored_cycles(path)
    assert data == cycles[300 - 128 : 1200 + 256].tobytes()
    assert metadata["outcome"]["states"][1:3] == [[301, "ARMED"], [701, "SWINGING"]]
    assert metadata["configuration"] == {"loop": {"rate": 1000}}
    assert metadata["real_time"] == {"scheduling": "FIFO"}
    assert metadata["calibrations"] == {"date": "2026-11-21"}
    assert metadata["complete"]
    assert read_snapshot(metadata, "x")["control"]["swings"][0] == 77
    assert read_profile(metadata, "x").name == metadata["profile"]["name"] == "default"
    first = cycles["time"][300 - 128] - time.monotonic() + time.time()
    assert datetime.fromisoformat(metadata["time_utc"]).timestamp() == pytest.approx(first, abs=1.0)
    bench.read_up()
    heart = bench.heartbeat()
    assert (heart["condition"], heart["done"], heart["waiting"], heart["lost"]) == (
        Condition.WORKING,
        1,
        0,
        0,
    )
    assert heart["tick"] == len(cycles)
    assert bench.end() == 0
    assert bench.event() == {"event": "ended", "waiting": 0}
    assert bench.heartbeat()["condition"] == Condition.ENDING


def test_recorder_cycles_waiting_in_ring_keep_record_time(bench: Bench, make_day: MakeDay) -> None:
    cycles = make_day([*SWING, (S.READY, 6000)])  # on a virtual clock: the newest is of now
    bench.write(cycles)
    recorder = Recorder(bench.plan(wall=False), 50.0)
    utc = 1e9
    for turn in range(4):
        recorder.turn(50.0 + turn, utc)
    recorder.finish("the test is over", 60.0)
    recorder.close()
    (path,) = bench.files()
    record, metadata = read_swing(path)
    first = metadata["begin"] + record["time"][0]
    found = datetime.fromisoformat(metadata["time_utc"]).timestamp()
    assert found == pytest.approx(utc - (cycles["time"][-1] - first), abs=1e-3)


def test_recorder_record_holds_corrected_profile(bench: Bench, day: MakeDay) -> None:
    profile = load_profile(find_profile("default"))
    basis = basis_of(profile)
    weights = np.random.default_rng(3).uniform(-1, 1, basis.size)
    bench.correct(400, 1, weights.tolist())
    bench.start()
    bench.read_up()
    bench.write(day(SWING)[:600])
    bench.read_up()
    bench.correct(600, 2, (2 * weights).tolist())
    bench.write(day(SWING)[600:])
    bench.event()
    _, metadata = stored_cycles(bench.files()[0])
    assert metadata["profile"]["correction"] == {"number": 2, "weights": (2 * weights).tolist()}
    swung, wanted = read_profile(metadata, "x"), basis.correction(2 * weights).applied_to(profile)
    assert np.array_equal(swung.angle, wanted.angle)
    assert np.array_equal(swung.valve, wanted.valve)
    assert swung.name == "default"


def test_recorder_correction_after_swing_is_not_recorded(bench: Bench, day: MakeDay) -> None:
    bench.start()
    cycles = day(SWING)
    bench.write(cycles[:1150])
    bench.read_up()
    bench.correct(1150, 1, [0.5] * basis_of(load_profile(find_profile("default"))).size)
    bench.write(cycles[1150:])
    bench.event()
    assert "correction" not in stored_cycles(bench.files()[0])[1]["profile"]


def test_recorder_sigterm_in_swing_stores_whole_swing(bench: Bench, day: MakeDay) -> None:
    cycles = day(SWING)
    bench.start()
    bench.write(cycles[:900])
    bench.read_up()
    bench.recorder.send_signal(signal.SIGTERM)
    for at in range(900, len(cycles), 50):
        bench.write(cycles[at : at + 50])
        time.sleep(0.01)
    assert bench.event()["complete"]
    assert bench.event()["event"] == "ended"
    data, _ = stored_cycles(bench.files()[0])
    assert data == cycles[300 - 128 : 1200 + 256].tobytes()


def test_recorder_loop_silent_in_swing_stores_partial_record(bench: Bench, day: MakeDay) -> None:
    bench.start(silence=0.2)
    bench.write(day(SWING)[:900])
    assert bench.event()["event"] == "stored"
    data, metadata = stored_cycles(bench.files()[0])
    assert len(data) == (900 - 300 + 128) * CYCLE.itemsize
    assert metadata["outcome"]["ended"] == "the loop fell silent"
    assert not metadata["complete"]


def test_recorder_restart_in_second_swing_stores_each_once(bench: Bench, day: MakeDay) -> None:
    both = day([*SWING, *SWING])
    bench.start(silence=60.0)
    bench.write(both[: len(both) // 2 + 900])
    assert bench.event()["number"] == 1
    bench.read_up()
    bench.kill()
    bench.write(both[len(both) // 2 + 900 :])
    bench.start()
    told = bench.event()
    assert (told["number"], told["complete"]) == (2, True)
    bench.read_up()
    first, second = bench.files()
    assert stored_cycles(first)[0] == both[300 - 128 : 1200 + 256].tobytes()
    assert stored_cycles(second)[0] == both[1600 + 300 - 128 : 1600 + 1200 + 256].tobytes()


@pytest.mark.parametrize("reached", ["renamed", "not yet renamed"])
def test_recorder_killed_before_heartbeat_stores_swing_once(bench: Bench, day: MakeDay, reached: str) -> None:
    cycles = day(SWING)
    bench.start()
    bench.write(cycles)
    bench.event()
    bench.read_up()
    bench.kill()
    heart = np.zeros(1, HEARTBEAT)
    bench.heart.read(heart)
    heart["done"], heart["tick"], heart["resume"] = 0, 0, 0
    bench.heart.write(heart)
    if reached == "not yet renamed":
        bench.files()[0].unlink()
    bench.start()
    bench.read_up()
    assert bench.end() == 0
    assert [stored_cycles(path)[0] for path in bench.files()] == [cycles[300 - 128 : 1200 + 256].tobytes()]
    assert bench.heartbeat()["done"] == 1


def test_recorder_killed_with_waiting_swing_stores_each_once(
    bench: Bench, day: MakeDay, small_disk: Callable[[int], None]
) -> None:
    """The first is stored; the second, for which the disk has no room, is still in memory."""
    both = day([*SWING, *SWING])
    bench.start(least_free=1)
    bench.write(both)
    assert bench.event()["event"] == "stored"
    told = bench.event()
    assert told["event"] == "fault"
    assert "No space left" in told["text"]
    bench.kill()
    small_disk(4)
    bench.start()
    bench.read_up()
    assert bench.end() == 0
    assert [stored_cycles(path)[0] for path in bench.files()] == [
        both[begin + 300 - 128 : begin + 1200 + 256].tobytes() for begin in (0, 1600)
    ]


def test_recorder_restart_before_swing_keeps_lead(bench: Bench, day: MakeDay) -> None:
    cycles = day(SWING)
    bench.start()
    bench.write(cycles[:290])
    bench.read_up()
    bench.kill()
    bench.start()
    bench.write(cycles[290:])
    assert bench.event()["event"] == "stored"
    assert stored_cycles(bench.files()[0])[0] == cycles[300 - 128 : 1200 + 256].tobytes()


def test_recorder_killed_at_random_leaves_complete_records(bench: Bench, day: MakeDay) -> None:
    """Killed while it stores; its successor removes partial files and stores the missing records."""
    choice = random.Random(3)
    once = day(SWING)
    kills = int(os.environ.get("GOLFBENCH_KILLS", "8"))
    for k in range(kills):
        cycles = once.copy()
        cycles["tick"] += k * len(once)
        cycles["time"] += 10.0 * k
        bench.start()
        bench.write(cycles)
        time.sleep(choice.uniform(0.0, 0.08))
        bench.kill()
        for path in bench.files():
            if not path.name.startswith("."):
                assert len(read_swing(path)[0]) == 128 + 900 + 256
    bench.start()
    bench.read_up()
    assert bench.end() == 0
    swings = {int(read_swing(path)[0]["tick"][-1]) for path in bench.files()}
    assert swings == {172 + 128 + 900 + 256 + k * len(once) for k in range(kills)}


def test_recorder_short_stall_loses_no_cycles(bench: Bench, day: MakeDay) -> None:
    cycles = day(SWING)
    bench.start()
    bench.write(cycles[:100])
    bench.read_up()
    bench.recorder.send_signal(signal.SIGSTOP)
    bench.write(cycles[100:])
    time.sleep(0.3)
    bench.recorder.send_signal(signal.SIGCONT)
    assert bench.event()["complete"]
    assert stored_cycles(bench.files()[0])[0] == cycles[300 - 128 : 1200 + 256].tobytes()
    assert bench.heartbeat()["lost"] == 0


@pytest.mark.parametrize("bench", [512], indirect=True)
def test_recorder_long_stall_counts_lost_cycles(bench: Bench, day: MakeDay) -> None:
    cycles = day(SWING)
    bench.start()
    bench.snapshot(301)
    for at in range(0, 600, 100):
        bench.write(cycles[at : at + 100])
        bench.read_up()
    bench.recorder.send_signal(signal.SIGSTOP)
    bench.write(cycles[600:1300])
    bench.recorder.send_signal(signal.SIGCONT)
    bench.read_up()
    bench.write(cycles[1300:])
    told = bench.event()
    assert (told["lost_records"], told["complete"], told["replayable"]) == (188, False, False)
    recorded, metadata = read_swing(bench.files()[0])
    assert metadata["lost_records"] == 188
    assert list(recorded["tick"]) == [*range(173, 601), *range(789, 1457)]
    assert bench.heartbeat()["lost"] == 188


def test_recorder_write_failure_reports_fault_and_retries(bench: Bench, day: MakeDay) -> None:
    cycles = day(SWING)
    bench.start()
    resource.prlimit(bench.recorder.pid, resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
    bench.write(cycles)
    told = bench.event()
    assert told["event"] == "fault"
    assert "nothing was stored" in told["text"]
    wait_until(lambda: bench.heartbeat()["condition"] == Condition.FAULT)
    assert bench.heartbeat()["waiting"] == 1
    wait_until(lambda: bench.files() == [])  # while it tries again there is a part of one
    resource.prlimit(bench.recorder.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
    assert bench.event()["event"] == "stored"
    assert bench.event() == {"event": "recovered"}
    assert stored_cycles(bench.files()[0])[0] == cycles[300 - 128 : 1200 + 256].tobytes()
    wait_until(lambda: bench.heartbeat()["condition"] == Condition.WORKING)


def test_recorder_data_path_is_file_reports_fault_and_recovers(bench: Bench) -> None:
    bench.data.write_text("a file, no folder")
    bench.start()
    assert "Not a directory" in (text := bench.event()["text"]) or "exists" in text
    wait_until(lambda: bench.heartbeat()["condition"] == Condition.FAULT)
    bench.data.unlink()
    assert bench.event() == {"event": "recovered"}


def test_recorder_end_with_unstored_swing_reports_waiting(bench: Bench, day: MakeDay) -> None:
    bench.start()
    resource.prlimit(bench.recorder.pid, resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
    bench.write(day(SWING))
    assert bench.event()["event"] == "fault"
    assert bench.end() == 74
    assert bench.event() == {"event": "ended", "waiting": 1}
    assert bench.files() == []


def test_recorder_supervisor_killed_records_until_loop_ends(bench: Bench, day: MakeDay) -> None:
    cycles = day([*ONCE[:2], (S.FAULT, 600)], cause=(650, Cause.SUPERVISOR))
    supervisor = bench.run("-c", run_below(RECORDER), plan=bench.plan())
    assert bench.event()["event"] == "ready"
    bench.write(cycles[:500])  # armed
    bench.read_up()
    supervisor.kill()
    supervisor.wait()
    for at in range(500, len(cycles), 50):
        bench.write(cycles[at : at + 50])
        time.sleep(0.01)
    wait_until(lambda: len(bench.files()) == 1 and not bench.files()[0].name.startswith("."))
    data, metadata = stored_cycles(bench.files()[0])
    assert data == cycles[300 - 128 : 700 + 256].tobytes()
    assert metadata["outcome"]["cause"] == "SUPERVISOR"


def test_recorder_missing_ring_reports_failed(bench: Bench) -> None:
    (bench.folder / "ring").unlink()
    bench.start_anyhow()
    told = bench.event()
    assert (told["event"], told["exit_code"]) == ("failed", 69)
    assert str(bench.folder / "ring") in told["location"]
    assert bench.recorder.wait(HURRY) == 69


# The disk itself -------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(bench: Bench) -> Iterator[Callable[[int], None]]:
    """Put the records on a disk of 1 MiB; return a function that makes it of so many MiB."""
    bench.data.mkdir()

    def mount(*options: str) -> bool:
        command = ["mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(bench.data)]
        return shutil.which("mount") is not None and subprocess.run(command, check=False).returncode == 0

    if os.geteuid() != 0 or not mount("size=1m"):
        pytest.skip("only root may mount a small disk")

    def make_room(size: int) -> None:
        assert mount("remount", f"size={size}m")

    yield make_room
    bench.kill()
    subprocess.run(["umount", str(bench.data)], check=True)
