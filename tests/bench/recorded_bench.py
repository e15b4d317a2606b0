"""A loop that writes given cycles, and the recorder process."""

from __future__ import annotations

import json
import os
import pickle
import select
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.loop.snapshot import SNAPSHOT
from bench.records.shot.recorded_shot import FlightConditions
from bench.records.telemetry.ring import RingWriter
from bench.supervisor.child_process import (
    CORRECTED,
    HEARTBEAT,
    TIMING_FILE,
    RecorderPlan,
    heartbeat_file,
    pack_correction,
)
from bench.supervisor.tick_timing import create_timing
from bench.swing.correction import basis_of
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.compiled import PLAIN
from drivers.base.shared_memory import SharedRecord

Cycles = np.ndarray[Any, Any]
HURRY = 10.0
"""s that anything may take on a busy machine."""

RECORDER = ("-m", "bench.supervisor.recorder")


class RecordedBench:
    """A loop that writes given cycles, and the recorder."""

    def __init__(self, folder: Path, capacity: int = 16384, program: Sequence[str] = RECORDER) -> None:
        """`program`: what Python is to run as the recorder."""
        self.folder, self.data = folder, folder / "data"
        self.writer = RingWriter(folder / "ring", capacity)
        self.snapshots = SharedRecord.create(folder / "snapshot", SNAPSHOT)
        self.corrected = SharedRecord.create(folder / "corrected", CORRECTED)
        self.heart = SharedRecord.create(heartbeat_file(folder, "recorder"), HEARTBEAT)
        self.timing = create_timing(folder / TIMING_FILE, 1_000_000)
        self.recorder: subprocess.Popen[bytes] | None = None
        self.begun = time.monotonic() - 100.0
        self.cycles: list[Cycles] = []
        self._heard = b""
        self._program = program

    def plan(self, **changes: Any) -> RecorderPlan:
        return RecorderPlan(
            **{
                "data_dir": self.data,
                "folder": self.folder,
                "snapshot_dtype": SNAPSHOT,
                "profile": (profile := load_profile(find_profile("default"))),
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

    def start(self, **changes: Any) -> None:
        self.start_anyhow(**changes)
        assert self.event()["event"] == "ready"

    def start_anyhow(self, **changes: Any) -> None:
        self.kill()
        self.recorder = subprocess.Popen(
            [sys.executable, *self._program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, PLAIN: "1"},
        )
        assert self.recorder.stdin is not None
        self.recorder.stdin.write(pickle.dumps(self.plan(**changes)))
        self.recorder.stdin.close()
        self._heard = b""

    def write(self, cycles: Cycles) -> None:
        for i in range(len(cycles)):
            self.writer(cycles[i : i + 1])
        self.cycles.append(cycles)

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
        assert self.recorder is not None
        assert self.recorder.stdout is not None
        deadline = time.monotonic() + HURRY
        while b"\n" not in self._heard and time.monotonic() < deadline:
            if select.select([self.recorder.stdout], [], [], 0.1)[0]:
                new = os.read(self.recorder.stdout.fileno(), 65536)
                if not new:
                    break
                self._heard += new
        line, _, self._heard = self._heard.partition(b"\n")
        assert line, "no event"
        event: dict[str, Any] = json.loads(line)
        return event

    def heartbeat(self) -> Any:
        record = np.zeros(1, HEARTBEAT)
        self.heart.read(record)
        return record[0]

    def wait_for(self, reached: Callable[[], bool]) -> None:
        deadline = time.monotonic() + HURRY
        while not reached():
            assert time.monotonic() < deadline
            time.sleep(0.005)

    def read_up(self) -> None:
        """Wait until the recorder has taken in all that is written."""
        count = int(self.heartbeat()["count"])
        self.wait_for(lambda: self.heartbeat()["count"] > count + 3)  # a turn that stores beats twice

    def signal(self, number: int) -> None:
        assert self.recorder is not None
        self.recorder.send_signal(number)

    def end(self) -> int:
        """Ask the recorder to end and return its exit code."""
        assert self.recorder is not None
        self.recorder.terminate()
        return self.recorder.wait(HURRY)

    def files(self) -> list[Path]:
        return sorted((self.data / "swings" / "b1").glob("*"))

    def kill(self) -> None:
        """End the recorder by force, if there is one."""
        if self.recorder is not None:
            self.recorder.kill()
            self.recorder.wait()
            if self.recorder.stdout is not None:
                self.recorder.stdout.close()

    def close(self) -> None:
        self.kill()
        for shared in (self.writer, self.snapshots, self.corrected, self.heart, self.timing):
            shared.close()
