"""A shared record between processes: full speed, and writers killed or stopped in the middle of a write.

GOLFBENCH_HOSTILE_SECONDS=60 makes the run at full speed longer.
"""

from __future__ import annotations

import itertools
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.base.shared_memory import SharedRecord
from tests.waiting import wait_until_stopped

pytestmark = pytest.mark.live

SECONDS = float(os.environ.get("GOLFBENCH_HOSTILE_SECONDS", "1.2"))
WORDS = 80
LARGE = 8192
"""Words of a record whose write takes so long that most signals come in its middle."""
STEP = 0x9E3779B97F4A7C15
"""Odd: word i of record s is s + i STEP, so no two records share a word at one place."""
ROUNDS = 20
"""Signals sent at least, and as many more as SECONDS allow."""

# Forks a writer whenever a line comes, tells its pid, buries it.
WRITERS = """
import os, sys
from pathlib import Path
import numpy as np
from drivers.base.shared_memory import SharedRecord

path, words = Path(sys.argv[1]), int(sys.argv[2])
dtype = np.dtype([("words", "u8", (words,))])
pattern = np.arange(words, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
for _ in sys.stdin:
    pid = os.fork()
    if pid == 0:
        record, shared = np.zeros(1, dtype), SharedRecord.open(path, dtype)
        number = shared.slots._last_written()
        content = record["words"][0]
        while True:
            number += 1
            np.add(pattern, np.uint64(number), out=content)
            shared.write(record)
    print(pid, flush=True)
    os.waitpid(pid, 0)
    print("dead", flush=True)
"""


def record_type(words: int) -> np.dtype[np.void]:
    return np.dtype([("words", "u8", (words,))])


class Writers:
    """Starts one writer after another; a record's version is the number in its content."""

    def __init__(self, path: Path, words: int) -> None:
        self._parent = subprocess.Popen(
            [sys.executable, "-c", WRITERS, str(path), str(words)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        self.pid = 0

    def start(self) -> None:
        assert self._parent.stdin
        self._parent.stdin.write("\n")
        self.pid = int(self._line())

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)
        assert self._line() == "dead"
        self.pid = 0

    def close(self) -> None:
        if self.pid:
            self.kill()
        self._parent.communicate(timeout=10)

    def _line(self) -> str:
        assert self._parent.stdout
        return self._parent.stdout.readline().strip()


class Check:
    """Reads a record and checks every word of it."""

    def __init__(self, path: Path, words: int) -> None:
        self.shared = SharedRecord.open(path, record_type(words))
        self._into = np.zeros(1, record_type(words))
        self._pattern = np.arange(words, dtype=np.uint64) * np.uint64(STEP)
        self.version = 0

    def read(self) -> int:
        """Return the version read, 0 before the first; fail on a torn or an older one."""
        version = self.shared.read(self._into)
        if version:
            assert np.array_equal(
                self._into["words"][0] - self._pattern, np.full(len(self._pattern), version)
            )
        assert version >= self.version
        self.version = version
        return version

    def wait_beyond(self, version: int) -> None:
        deadline = time.monotonic() + 10
        while self.read() <= version:
            assert time.monotonic() < deadline, "the writer does not write"
            time.sleep(0.0005)


@pytest.fixture
def record(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[tuple[Writers, Check]]:
    """Return writers and a checking reader of one record with as many words as the test's parameter."""
    path, words = tmp_path / "record", request.param
    shared = SharedRecord.create(path, record_type(words))
    writers, check = Writers(path, words), Check(path, words)
    writers.start()
    check.wait_beyond(0)
    yield writers, check
    writers.close()
    check.shared.close()
    shared.close()


def pauses() -> Iterator[float]:
    """Return random times (s) to wait before a signal: ROUNDS, and more for half of SECONDS."""
    chance, deadline = random.Random(1), time.monotonic() + SECONDS / 2
    for number in itertools.count():
        if number >= ROUNDS and time.monotonic() > deadline:
            return
        yield chance.uniform(0, 0.002)


def in_the_middle_of_a_write(check: Check) -> bool:
    """Return whether the writer, now stopped, has an unfinished write."""
    slots = check.shared.slots
    word = (128 + (slots.head + 1) % slots.slots * slots._stride) >> 3
    return slots._words[word] == slots.head + 1 != slots._words[word + slots._end]


@pytest.mark.parametrize("record", [WORDS, LARGE], indirect=True)
def test_shared_record_full_speed_reads_no_torn_record(record: tuple[Writers, Check]) -> None:
    _, check = record
    versions, deadline = set(), time.monotonic() + SECONDS / 2
    while time.monotonic() < deadline:
        versions.add(check.read())
    assert len(versions) > 10, "the reader gets new values, not for ever its previous one"


@pytest.mark.parametrize("record", [LARGE], indirect=True)
def test_shared_record_writer_stopped_mid_write_reader_continues(record: tuple[Writers, Check]) -> None:
    writers, check = record
    rounds = middles = 0
    for pause in pauses():
        rounds += 1
        time.sleep(pause)
        os.kill(writers.pid, signal.SIGSTOP)
        wait_until_stopped(writers.pid)
        middles += in_the_middle_of_a_write(check)
        newest = check.shared.slots.head
        assert check.read() == check.read() == newest
        os.kill(writers.pid, signal.SIGCONT)
        check.wait_beyond(newest)
    assert middles > rounds / 10, "the test means it"


@pytest.mark.parametrize("record", [LARGE], indirect=True)
def test_shared_record_writer_killed_mid_write_next_writer_continues(
    record: tuple[Writers, Check], tmp_path: Path
) -> None:
    writers, check = record
    rounds = middles = 0
    for pause in pauses():
        rounds += 1
        time.sleep(pause)
        writers.kill()
        middles += in_the_middle_of_a_write(check)
        newest = check.shared.slots.head
        assert check.read() == newest
        late = Check(tmp_path / "record", LARGE)
        assert late.read() == newest, "also for a reader that comes only now"
        late.shared.close()
        writers.start()
        check.wait_beyond(newest)
    assert middles > rounds / 10, "the test means it"
