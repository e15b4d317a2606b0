"""A loop that only writes given cycles, and a service process of the bench on its files."""

from __future__ import annotations

import json
import os
import pickle
import select
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench.records.telemetry.ring import RingWriter
from bench.supervisor._tick_timing import create_timing
from bench.supervisor.child_process import HEARTBEAT, RING_FILE, TIMING_FILE, heartbeat_file
from drivers.base.shared_memory import SharedRecord
from tests.waiting import HURRY

Cycles = np.ndarray[Any, Any]


class ServiceProcess(subprocess.Popen[bytes]):
    """A Python process that gets a plan and prints its events."""

    def __init__(self, *arguments: str, plan: object = None, **environment: str) -> None:
        super().__init__(
            [sys.executable, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            env={**os.environ, **environment},
        )
        if plan is not None:
            assert self.stdin is not None
            self.stdin.write(pickle.dumps(plan))
            self.stdin.close()

    def line(self) -> bytes:
        """Wait for the next line and return it."""
        assert self.stdout is not None
        assert select.select([self.stdout], [], [], HURRY)[0], "no output"
        return self.stdout.readline().strip()

    def event(self) -> dict[str, Any]:
        """Wait for the next event and return it."""
        event: dict[str, Any] = json.loads(self.line())
        return event

    def end_by_force(self) -> None:
        self.kill()
        self.wait()
        for stream in (self.stdout, self.stdin):
            if stream is not None:
                stream.close()


class ServiceBench:
    """A loop that writes given cycles, and the processes that were started on its files."""

    def __init__(self, folder: Path, service: str, capacity: int) -> None:
        """`service` is the name of the process that beats the heart."""
        self.folder = folder
        self.writer = RingWriter(folder / RING_FILE, capacity)
        self.timing = create_timing(folder / TIMING_FILE, 1_000_000)
        self.heart = SharedRecord.create(heartbeat_file(folder, service), HEARTBEAT)
        self.processes: list[ServiceProcess] = []

    def run(self, *arguments: str, plan: object = None, **environment: str) -> ServiceProcess:
        self.processes.append(ServiceProcess(*arguments, plan=plan, **environment))
        return self.processes[-1]

    def write(self, cycles: Cycles, pace: float = 0.0) -> None:
        """Write `cycles`, 20 at a time with `pace` (s) between."""
        for i in range(len(cycles)):
            self.writer(cycles[i : i + 1])
            if pace and i % 20 == 19:
                time.sleep(pace)

    def heartbeat(self) -> Any:
        record = np.zeros(1, HEARTBEAT)
        self.heart.read(record)
        return record[0]

    def kill(self) -> None:
        """End all processes by force."""
        for process in self.processes:
            process.end_by_force()

    def close(self) -> None:
        self.kill()
        for shared in (self.writer, self.timing, self.heart):
            shared.close()


def run_below(module: str) -> str:
    """Return a program that runs `module` as its child, as a supervisor does."""
    return f"import subprocess, sys\nsubprocess.Popen([sys.executable, '-m', '{module}']).wait()"
