"""The child's side of a supervised process: plan on stdin, JSON lines on stdout, heartbeat in shared memory.

The plan is a pickled frozen dataclass from the parent, through a file that no other process can write to.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import sys
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.base.errors import BenchError, ExitCode
from bench.base.interrupt import HANGUP
from bench.base.lifecycle import Cause
from drivers.base import DriverError
from drivers.base.compile_report import announce_compilation
from drivers.base.shared_memory import SharedMemoryError, SharedRecord

if TYPE_CHECKING:  # each process loads only what it needs
    from bench.config import Configuration
    from bench.records.shot.recorded_shot import FlightConditions
    from bench.records.telemetry.encoder_preset import CalibratedShifts
    from bench.swing.correction import Basis
    from bench.swing.profile import Profile
    from drivers.launch_monitor.settings import LaunchMonitorSettings
    from sim.plant import PlantParameters

FOR_PARENT = (signal.SIGINT, signal.SIGABRT, *HANGUP)
"""Signals sent to the whole process group and handled by the parent: SIGINT from a terminal or systemd's
stop, SIGABRT from systemd's watchdog, a closed terminal. A child starts with them blocked."""


@dataclass(frozen=True)
class LoopPlan:
    """Parameters of the loop process."""

    configuration: Configuration
    """Configuration with the calibration applied."""
    profile: Profile
    basis: Basis
    """Basis of its corrections; passed, as computing it imports all of scipy's interpolation."""
    folder: Path
    """Shared-memory folder of the bench."""
    lock: int
    """Inherited descriptor of its locked file."""
    first_cause: Cause = Cause.POWER_UP
    """Cause of the initial ESTOP."""
    read_only: bool = False
    """Whether only the passive command is sent."""
    calibrated: CalibratedShifts | None = None
    """Zero shifts that the encoders reported at their calibration; None if not calibrated."""


@dataclass(frozen=True)
class LaunchMonitorPlan:
    """Parameters of the launch monitor process."""

    run: str
    """Id of the bench's run."""
    folder: Path
    """Shared-memory folder of the bench."""
    settings: LaunchMonitorSettings
    plant: PlantParameters
    around: FlightConditions
    club: str
    """Code of the club in the player message to monitors."""
    wall: bool
    """Whether loop time is CLOCK_MONOTONIC; otherwise virtual."""


RING_FILE, TIMING_FILE, SNAPSHOT_FILE = "ring", "timing", "snapshot"
"""Names of the files written by the loop in the bench's folder in shared memory."""


def heartbeat_file(folder: Path, name: str) -> Path:
    """Return the file of the heartbeat of process `name` in the bench's `folder`."""
    return folder / f"{name}-heart"


class Condition(IntEnum):
    """Condition reported by a child."""

    STARTING = 0
    WORKING = 1
    FAULT = 2
    """Temporarily unable to work, retrying; arming is refused."""
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
"""Heartbeat of a child, many times a second: beat counter, time of the beat (s, CLOCK_MONOTONIC),
`Condition`, ring records lost, work done (files stored, batches sent) and waiting, and the last completed
tick. For a restarted recorder: the tick after which to resume reading, which includes the lead of the next
record, and number, begin (s, UTC) and last tick of the record being stored. The supervisor creates the file,
so that a restarted child continues in it."""


class HeartbeatSender:
    """The child's side of a heartbeat."""

    def __init__(self, folder: Path, name: str) -> None:
        """Open the file of process `name` in the bench's `folder`.

        Raises:
            SharedMemoryError: the supervisor has not created it, or it cannot be used.
        """
        self._shared = SharedRecord.open(heartbeat_file(folder, name), HEARTBEAT)
        self.last = np.zeros(1, HEARTBEAT)
        """Last heartbeat, initially that of the previous process."""
        self._shared.read(self.last)

    def beat(self, time: float, condition: Condition, **figures: float) -> None:
        """Write a heartbeat with `condition` and `figures` (fields of HEARTBEAT) at `time` (s)."""
        self.last["count"] += 1
        self.last["time"], self.last["condition"] = time, condition
        for name, value in figures.items():
            self.last[name] = value
        self._shared.write(self.last)

    def close(self) -> None:
        """Unmap; the file stays."""
        self._shared.close()


class Parent:
    """Stop requests of the supervisor: SIGTERM, or its death. Ctrl-C is left to the supervisor."""

    def __init__(self, pid: int = 0) -> None:
        """`pid` is the supervisor's, by default this process' parent."""
        self.pid = pid or os.getppid()
        self.stop_requested = False
        """Whether SIGTERM was received."""

    def listen(self) -> None:
        """Handle SIGTERM as a stop request and ignore FOR_PARENT; before this call SIGTERM kills."""
        signal.signal(signal.SIGTERM, self._note)
        for number in FOR_PARENT:
            signal.signal(number, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, FOR_PARENT)

    @property
    def gone(self) -> bool:
        """Whether the supervisor died."""
        return os.getppid() != self.pid

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.stop_requested = True


def read_plan() -> Any:
    """Return the plan sent by the parent; from now on compilations are reported to it."""
    announce_compilation(lambda text: send_event("compiling", text=text))
    return pickle.load(sys.stdin.buffer)  # noqa: S301 - from the parent, see above


def send_event(event: str, **details: Any) -> None:
    """Write one JSON line to the parent; dropped if the parent does not read, never blocking."""
    line = json.dumps({"event": event, **details}) + "\n"
    descriptor = sys.stdout.fileno()
    with suppress(OSError):
        os.set_blocking(descriptor, False)
        os.write(descriptor, line.encode())  # below PIPE_BUF writes are atomic


def send_failure(error: BenchError | SharedMemoryError | DriverError) -> int:
    """Report `error` to the parent as the reason of failure, and return the exit code."""
    if isinstance(error, DriverError):
        location, found = "driver", str(error)
        expected, action = "a working device", "Correct the fault, then restart."
    else:
        location, found, expected, action = error.args
    code = error.exit_code if isinstance(error, BenchError) else ExitCode.DEVICE
    send_event(
        "failed", location=location, found=found, expected=expected, action=action, exit_code=int(code)
    )
    return int(code)
