"""The ring between processes: a hostile reader at a writer's full speed, and processes killed or stopped.

GOLFBENCH_HOSTILE_SECONDS=60 makes the runs at full speed longer.
"""

from __future__ import annotations

import itertools
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.ring import RingReader
from tests.waiting import wait_until_stopped

pytestmark = pytest.mark.live

SECONDS = float(os.environ.get("GOLFBENCH_HOSTILE_SECONDS", "1.2"))
PATTERN = np.arange(CYCLE.itemsize // 8, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
"""Word i of record s is s plus this, so no two records share a word at one place."""

WRITER = """
import select, sys
from pathlib import Path
import numpy as np
from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.ring import RingWriter

write = RingWriter(Path(sys.argv[1]), int(sys.argv[2]))
print("ready", flush=True)
record = np.zeros(1, CYCLE)
content = record.view(np.uint64)
pattern = np.arange(len(content), dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
number = 0
sys.stdin.readline()
while not select.select([sys.stdin], [], [], 0)[0]:
    for _ in range(2000):
        number += 1
        np.add(pattern, np.uint64(number), out=content)
        write(record)
print(number, flush=True)
"""

READER = """
import sys
from pathlib import Path
from bench.records.telemetry.ring import RingReader

reader = RingReader(Path(sys.argv[1]))
print("ready", flush=True)
while True:
    reader.read()
    reader.newest()
"""

Start = Callable[..., "subprocess.Popen[str]"]


class Check:
    """Checks every word a reader gets, and that the numbers missing are those it counts as lost.

    Opened before the first record, or `from_oldest` while the writer rests.
    """

    def __init__(self, path: Path, *, from_oldest: bool = False) -> None:
        self.reader = RingReader(path, from_oldest=from_oldest)
        self.received = self.missing = 0
        self._last = max(0, self.reader.head - self.reader.capacity) if from_oldest else 0

    def read(self) -> int:
        """Return how many records came."""
        numbers = self._numbers(self.reader.read())
        if len(numbers):
            steps = np.diff(numbers, prepend=self._last)
            assert steps.min() >= 1
            self.received += len(numbers)
            self.missing += int((steps - 1).sum())
            self._last = int(numbers[-1])
            assert self.missing <= self.reader.lost
        return len(numbers)

    def newest(self) -> int:
        newest = self.reader.newest()
        return 0 if newest is None else int(self._numbers(newest)[0])

    def _numbers(self, cycles: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        words = cycles.view(np.uint64).reshape(len(cycles), len(PATTERN)) - PATTERN
        assert (words == words[:, :1]).all(), "torn"
        return words[:, 0].astype(np.int64)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ring"


@pytest.fixture
def start(path: Path) -> Iterator[Start]:
    """Return a function that starts a program on the ring and waits until it is ready."""
    started: list[subprocess.Popen[str]] = []

    def start(program: str, *arguments: int) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", program, str(path), *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        started.append(process)
        assert process.stdout
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def go(writer: subprocess.Popen[str]) -> None:
    assert writer.stdin
    writer.stdin.write("\n")


def end(writer: subprocess.Popen[str]) -> int:
    """End the writer and return how many records it has written."""
    return int(writer.communicate("\n", timeout=10)[0])


@pytest.mark.parametrize("capacity", [8, 1024, 16384])
def test_ring_reader_fast_writer_gives_no_torn_record_and_counts_losses(
    capacity: int, start: Start, path: Path
) -> None:
    writer = start(WRITER, capacity)
    check = Check(path)
    go(writer)
    deadline = time.monotonic() + SECONDS
    newest = 0
    while time.monotonic() < deadline:
        check.read()
        assert check.newest() >= newest
        newest = check.newest()
    written = end(writer)
    while check.read():
        pass
    assert check.reader.head == check.newest() == written
    assert check.received + check.reader.lost == written
    assert check.missing == check.reader.lost
    assert check.received > 100
    print(f"capacity {capacity}: {written} written, {check.received} read, {check.missing} lost, 0 torn")
    check.reader.close()


def test_ring_reader_stopped_or_killed_writer_does_not_block(start: Start, path: Path) -> None:
    writer = start(WRITER, 16)
    check, chance, deadline = Check(path), random.Random(3), time.monotonic() + SECONDS / 2
    go(writer)
    for rounds in itertools.count():
        if rounds >= 20 and time.monotonic() > deadline:
            break
        time.sleep(chance.uniform(0, 0.002))
        os.kill(writer.pid, signal.SIGSTOP)
        wait_until_stopped(writer.pid)
        while check.read():
            pass
        head = check.reader.head
        assert check.received + check.reader.lost == check.newest() == head
        late = Check(path, from_oldest=True)
        late.read()
        assert late.received + late.reader.lost == min(16, head)
        assert late.reader.lost <= 1, "the one that was just being overwritten"
        late.reader.close()
        os.kill(writer.pid, signal.SIGCONT)
    writer.kill()
    writer.wait()
    while check.read():
        pass
    assert check.received + check.reader.lost == check.newest() == check.reader.head
    check.reader.close()


def test_ring_writer_killed_or_stopped_reader_does_not_block(start: Start, path: Path) -> None:
    writer = start(WRITER, 64)
    stopped, check = start(READER), Check(path)
    go(writer)
    os.kill(stopped.pid, signal.SIGSTOP)
    for _ in range(2):
        reader = start(READER)
        head = check.reader.head
        reader.kill()
        reader.wait()
        deadline = time.monotonic() + 10
        while check.reader.head < head + 1000:
            assert time.monotonic() < deadline, "the writer writes no more"
            check.read()
    assert end(writer) == check.reader.head
    check.reader.close()
