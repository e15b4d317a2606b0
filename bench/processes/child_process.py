"""A process of the bench as its supervisor starts it: plan on stdin, JSON lines on stdout, heartbeat beside.

The plan is a pickled frozen dataclass: it comes from the parent through a pipe that nobody else can write to.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import sys
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from bench.errors import BenchError, ExitCode
from drivers.base import DriverError
from drivers.base.shared_record import SharedMemoryError, SharedRecord

FOR_PARENT = (signal.SIGINT, signal.SIGABRT)
"""Signals that come to all processes at once and are the parent's: SIGINT from a shared terminal or as
systemd's stop, SIGABRT from systemd's watchdog. A child is started with them blocked."""


class Condition(IntEnum):
    """How a child says it is."""

    STARTING = 0
    WORKING = 1
    TROUBLE = 2
    """It cannot do its work for now and tries again; nothing more is to be armed."""
    ENDING = 3


HEARTBEAT = np.dtype(
    [
        ("count", "i8"),
        ("time", "f8"),
        ("condition", "u1"),
        ("lost", "i8"),
        ("done", "i8"),
        ("waiting", "i8"),
        ("tick", "i8"),
        ("resume", "i8"),
        ("storing", "i8"),
        ("storing_began", "f8"),
        ("storing_tick", "i8"),
    ],
    align=True,
)
"""What a child tells many times a second: beats so far, CLOCK_MONOTONIC of this one (s), `Condition`, ring
records lost by this process, work done (files stored, batches sent) and kept for later, and the last tick
that is done with. For the recorder after this one: the tick after which it is to read, which spares the lead
of a record to come, and of the record that is being stored the number, its begin (s, UTC) and its last tick.
The supervisor makes the file, so that a child started anew goes on in it."""


class HeartbeatSender:
    """The child's side of a heartbeat."""

    def __init__(self, path: Path) -> None:
        """Go on in the file at `path`, or make it.

        Raises:
            SharedMemoryError: it cannot be made or used.
        """
        try:
            self._shared = SharedRecord.open(path, HEARTBEAT)
        except SharedMemoryError:
            if path.exists():
                raise
            self._shared = SharedRecord.create(path, HEARTBEAT)
        self.last = np.zeros(1, HEARTBEAT)
        """What was told last, also by the process before this one."""
        self._shared.read(self.last)

    def beat(self, time: float, condition: Condition, **figures: float) -> None:
        """Tell `condition` and any of `figures` (fields of HEARTBEAT) at `time` (s)."""
        self.last["count"] += 1
        self.last["time"], self.last["condition"] = time, condition
        for name, value in figures.items():
            self.last[name] = value
        self._shared.write(self.last)

    def close(self) -> None:
        """Unmap; the file stays."""
        self._shared.close()


class Parent:
    """What the supervisor wants: an end, by SIGTERM or by not being there any more. Ctrl-C is its own."""

    def __init__(self) -> None:
        self._parent = os.getppid()
        self.wants_end = False
        """SIGTERM has come."""

    def listen(self) -> None:
        """Take SIGTERM as a wish, from now on, and ignore FOR_PARENT; before, SIGTERM ends it at once."""
        signal.signal(signal.SIGTERM, self._note)
        for number in FOR_PARENT:
            signal.signal(number, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, FOR_PARENT)

    @property
    def gone(self) -> bool:
        """Whether the supervisor died."""
        return os.getppid() != self._parent

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.wants_end = True


def read_plan() -> Any:
    """Return the plan that the parent sent."""
    return pickle.load(sys.stdin.buffer)  # noqa: S301 - from the parent, see above


def tell(event: str, **details: Any) -> None:
    """Write one JSON line to the parent. Nobody there to read it: it is dropped, never waited for."""
    line = json.dumps({"event": event, **details}) + "\n"
    descriptor = sys.stdout.fileno()
    with suppress(OSError):
        os.set_blocking(descriptor, False)
        os.write(descriptor, line.encode())  # below PIPE_BUF it is written whole or not at all


def tell_failure(error: BenchError | SharedMemoryError | DriverError) -> int:
    """Tell the parent that this process cannot work because of `error`, and return its exit code."""
    if isinstance(error, DriverError):
        place, found = "driver", str(error)
        expected, cure = "a device that does its work", "Mend it, then start again."
    else:
        place, found, expected, cure = error.args
    code = error.exit_code if isinstance(error, BenchError) else ExitCode.DEVICE
    tell("failed", place=place, found=found, expected=expected, cure=cure, exit_code=int(code))
    return int(code)
