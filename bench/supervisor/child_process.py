"""Child processes of the supervisor: plan on stdin, JSON lines on stdout, heartbeat in shared memory.

First the child's side. The plan is a pickled frozen dataclass from the parent, through a file that no other
process can write to. Then the parent's side: children are started, read, monitored, restarted and stopped.
Support processes (recorder, publisher and others) have a heartbeat. Arming requires recorder and publisher.
"""

from __future__ import annotations

import json
import logging
import os
import pickle
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from bench.base.errors import BenchError, ExitCode
from bench.base.interrupt import HANGUP
from bench.base.json_schema import json_object
from bench.base.lifecycle import Cause
from bench.base.process import import_path
from bench.swing.correction_terms import MAX_WEIGHTS
from drivers.base import DriverError
from drivers.base.compile_report import announce_compilation, report_compilation
from drivers.base.compiled import PLAIN
from drivers.base.shared_memory import SharedMemoryError, SharedRecord

if TYPE_CHECKING:  # each process loads only what it needs
    from bench.base.address import NetworkSettings
    from bench.config import Configuration
    from bench.records.shot.recorded_shot import FlightConditions
    from bench.records.telemetry.encoder_preset import CalibratedShifts
    from bench.swing.correction import Basis
    from bench.swing.profile import Profile
    from drivers.launch_monitor.settings import LaunchMonitorSettings
    from sim.plant import PlantParameters

FOR_PARENT = (signal.SIGINT, signal.SIGABRT, signal.SIGTSTP, *HANGUP)
"""Signals sent to the whole process group and handled by the parent: SIGINT from a terminal or systemd's
stop, SIGABRT from systemd's watchdog, SIGTSTP by Ctrl-Z, a closed terminal. A child starts with them
blocked."""


@dataclass(frozen=True)
class LoopPlan:
    """Parameters of the loop process."""

    configuration: Configuration
    """Configuration with the calibration applied."""
    profile: Profile
    basis: Basis
    """Basis of its corrections."""
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


@dataclass(frozen=True)
class RecorderPlan:
    """Parameters of the recorder."""

    data_dir: Path
    folder: Path
    """Shared-memory folder of the bench."""
    snapshot_dtype: np.dtype[Any]
    """`bench.loop.snapshot.SNAPSHOT`, passed so that the recorder need not import the controller."""
    profile: Profile
    basis: Basis
    """Basis of its corrections."""
    run: Mapping[str, Any]
    """Entries of all records: id of the `bench` and of its `run`, the prefix of shot ids; `configuration`,
    `versions` and `calibrations`; `real_time`, the settings requested by the loop and granted."""
    around: FlightConditions
    """Air, wind and turf of the flights of `plant`."""
    wall: bool = True
    """Whether loop time is CLOCK_MONOTONIC; otherwise virtual."""
    lead: float = 0.5
    tail: float = 0.5
    """Lead before and tail after each record, s."""
    plant: PlantParameters | None = None
    """Plant whose club and ball the shots of stored swings are computed with; None: they are not."""
    room: int = 65536
    """Max cycles of the current record in memory, 0.7 kB each."""
    waiting: int = 8
    """Max records waiting in memory for the disk."""
    least_free: int = 64 << 20
    """Min free disk space (bytes) for arming."""
    silence: float = 1.0
    """Time without a cycle after which the current record ends, s."""
    timeout: float = 10.0
    """Time for which an end waits for the current swing, s."""


@dataclass(frozen=True)
class PublisherPlan:
    """Parameters of the publisher."""

    bench: str
    network: NetworkSettings
    folder: Path
    """Shared-memory folder of the bench."""
    wall: bool = True
    """Whether loop time is CLOCK_MONOTONIC; otherwise virtual."""


RING_FILE, TIMING_FILE, SNAPSHOT_FILE = "ring", "timing", "snapshot"
"""Names of the files written by the loop in the bench's folder in shared memory."""

CORRECTION_FILE, CORRECTED_FILE = "correction", "corrected"
"""Names of the files with the correction ordered by the supervisor, and the one active in the loop."""

CORRECTION = np.dtype([("number", "i8"), ("size", "i8"), ("weights", "f8", (MAX_WEIGHTS,))], align=True)
"""Order of a correction with `size` weights, 0 for the profile as designed; a new `number` is a new order."""

CORRECTED = np.dtype([("asked", "i8"), ("tick", "i8"), ("order", CORRECTION)], align=True)
"""`asked` is the number of the last order processed, `order` the one active since `tick`."""


def pack_correction(number: int, weights: Sequence[float]) -> np.ndarray[Any, Any]:
    """Return order `number` (one-element array of CORRECTION)."""
    order = np.zeros(1, CORRECTION)
    order["number"], order["size"] = number, len(weights)
    order["weights"][0, : len(weights)] = weights
    return order


def weights_of(order: np.ndarray[Any, Any]) -> list[float]:
    """Return the weights in `order` (one element of CORRECTION)."""
    weights: list[float] = order["weights"].reshape(-1)[: int(order["size"].reshape(-1)[0])].tolist()
    return weights


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

    def beat(self, now: float, condition: Condition, **figures: float) -> None:
        """Write a heartbeat with `condition` and `figures` (fields of HEARTBEAT) at `now` (s)."""
        self.last["count"] += 1
        self.last["time"], self.last["condition"] = now, condition
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

    @property
    def wants_end(self) -> bool:
        """Whether this process shall end."""
        return self.stop_requested or self.gone

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.stop_requested = True


Service = TypeVar("Service")


def begin_service(build: Callable[[Any], Service]) -> tuple[Parent, Service]:
    """Return the parent and the service that `build` makes of the plan, and report ready; else exit."""
    parent = Parent()
    try:
        service = build(read_plan())
    except (BenchError, SharedMemoryError, DriverError) as error:
        sys.exit(send_failure(error))
    parent.listen()
    send_event("ready")
    return parent, service


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


# The parent's side -----------------------------------------------------------------------------------

_log = logging.getLogger("golfbench")

_READ = 65536


class NotStarted(BenchError):
    """A process of the bench did not become ready."""

    exit_code = ExitCode.DEVICE


class Child:
    """One child process; `events` holds its received events."""

    def __init__(self, name: str, process: subprocess.Popen[bytes]) -> None:
        """Adopt `process`, whose stdout is a pipe of JSON lines."""
        self.name, self.process = name, process
        self.events: list[dict[str, Any]] = []
        self._partial_line = b""
        if process.stdout is not None:
            os.set_blocking(process.stdout.fileno(), False)

    @classmethod
    def start(
        cls, name: str, module: str, plan: object, pass_fds: tuple[int, ...] = (), *, plain: bool = False
    ) -> Child:
        """Start `python -m module` with `plan` pickled on its stdin, without waiting.

        With `plain` it runs without numba, which would take 70 MB and longer to load than a shot to compute.

        The plan is passed in a memory file: writing a large one to a pipe would block until the child reads.
        Signals meant for the parent are blocked in the child from its first instruction on.
        """
        # Further BLAS threads disturb the timing. Arrow's own allocator keeps the memory of a record.
        with open(os.memfd_create("plan"), "w+b", buffering=0) as stdin:
            stdin.write(pickle.dumps(plan))
            stdin.seek(0)
            before = signal.pthread_sigmask(signal.SIG_BLOCK, FOR_PARENT)
            try:
                process = subprocess.Popen(
                    [sys.executable, "-P", "-m", module],
                    bufsize=0,
                    stdin=stdin,
                    stdout=subprocess.PIPE,
                    pass_fds=pass_fds,
                    env={
                        **os.environ,
                        "PYTHONPATH": import_path(),
                        "OPENBLAS_NUM_THREADS": "1",
                        "ARROW_DEFAULT_MEMORY_POOL": "system",
                        **({PLAIN: "1"} if plain else {}),
                    },
                )
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return cls(name, process)

    @property
    def pid(self) -> int:
        """Process id."""
        return self.process.pid

    @property
    def alive(self) -> bool:
        """Whether it runs or is stopped by a signal."""
        return self.process.poll() is None

    @property
    def ending(self) -> str:
        """How it ended, as text; empty while it runs."""
        code = self.process.poll()
        if code is None:
            return ""
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    def listen(self) -> None:
        """Read its events without blocking."""
        if self.process.stdout is None or self.process.stdout.closed:
            return
        with suppress(BlockingIOError):
            while new := os.read(self.process.stdout.fileno(), _READ):
                self._partial_line += new
        *lines, self._partial_line = self._partial_line.split(b"\n")
        for line in lines:
            event = json_object(line)
            if event is not None and isinstance(event.get("event"), str):
                self.events.append(event)

    def take_events(self) -> list[dict[str, Any]]:
        """Return its events since the last call."""
        self.listen()
        taken, self.events = self.events, []
        return taken

    def wait_until_ready(self, timeout: float) -> dict[str, Any]:
        """Wait up to `timeout` (s) for its event `ready` and return it; again as long while it compiles.

        Raises:
            NotStarted: it reported a failure, ended, or the time-out expired.
        """
        deadline = time.monotonic() + timeout
        stdout = self.process.stdout
        while time.monotonic() < deadline:
            ended = not self.alive
            self.listen()
            while self.events:
                event = self.events.pop(0)  # later events remain for `take_events`
                if event["event"] == "ready":
                    return event
                if event["event"] == "failed":
                    error = NotStarted(*(event[part] for part in ("location", "found", "expected", "action")))
                    error.exit_code = ExitCode(event["exit_code"])
                    raise error
                if event["event"] == "compiling":
                    report_compilation(event["text"])
                    deadline = time.monotonic() + timeout
            if ended:
                action = "See the output of the process above."
                raise NotStarted(f"{self.name} process", self.ending, "a ready process", action)
            select.select([stdout] if stdout else [], [], [], 0.1)
        found = f"not ready after {timeout:g} s"
        action = "Check the load of the machine with `golfbench doctor`, then start again."
        raise NotStarted(f"{self.name} process", found, "a ready process", action)

    def end(self, timeout: float) -> None:
        """Terminate it, wait up to `timeout` (s), then kill it; allowed when it has ended."""
        with suppress(ProcessLookupError):
            self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout)
        self.kill()

    def kill(self) -> None:
        """Kill it and close its pipe."""
        with suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()
        self.listen()
        if self.process.stdout is not None:
            self.process.stdout.close()


_SILENCE = 5.0
"""Heartbeat time-out after which a process is not ready, s; storing a swing may take some seconds on a busy
machine, and the ring keeps 16 s."""
_FROZEN = 12.0
"""Heartbeat time-out after which a process is killed and restarted, s."""
_PAUSE = 1.0
"""Delay before a restart, s."""
_TIMEOUT = 12.0
"""Time a process may take to end and store its data, s."""


class ManagedProcess:
    """One support process."""

    def __init__(
        self,
        name: str,
        folder: Path,
        start: Callable[[], Child],
        listener: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> None:
        """Create its heartbeat's file in the bench's `folder`; `start` starts it, `listener` gets its events.

        Raises:
            SharedMemoryError: the file cannot be created.
        """
        self.name, self._start, self._listener = name, start, listener
        self._shared = SharedRecord.create(heartbeat_file(folder, name), HEARTBEAT)
        self._beat = np.zeros(1, HEARTBEAT)
        self._condition, self._beats, self._heard = Condition.STARTING, -1, -np.inf
        """Condition and number of the last heartbeat, and its time on the supervisor's clock (s)."""
        self.child: Child | None = None
        self._died = -np.inf
        self._ending = False
        self.note = "starting"
        """Condition as text; empty while working."""

    @property
    def ready(self) -> bool:
        """Whether it is working."""
        return not self.note

    @property
    def starting(self) -> bool:
        """Whether it has not worked yet."""
        return self._condition is Condition.STARTING

    def turn(self, now: float) -> None:
        """Check it at `now` (s); start it if it does not run."""
        if self.child is not None and not self.child.alive:
            _log.error("%s %s; restarting", self.name, self.child.ending)
            self.child.kill()
            self.child, self._died = None, now
        if self._ending:
            return
        if self.child is None:
            self.note = "dead, restarting"
            if now - self._died < _PAUSE:
                return
            self.child, self._condition, self._beats = self._start(), Condition.STARTING, -1
        self._shared.read(self._beat)
        if (count := int(self._beat["count"][0])) != self._beats:
            if self._beats != -1:  # the first value is from the previous process
                self._condition = Condition(int(self._beat["condition"][0]))
            self._beats, self._heard = count, now
        self.note = self._fault(now)
        if not self.starting and now - self._heard > _FROZEN:
            self.child.kill()  # restarted in the next turns
        for event in self.child.take_events():
            if event["event"] in {"fault", "dropped", "failed", "recovered"}:
                _log.warning("%s: %s", self.name, event)
            else:
                self._listener(event)

    def _fault(self, now: float) -> str:
        if not self.starting and (silent := now - self._heard) > _SILENCE:
            return f"silent for {silent:.1f} s"
        return "" if self._condition is Condition.WORKING else self._condition.name.lower()

    def stop_restarting(self) -> None:
        """Do not restart it from now on: the bench is shutting down."""
        self._ending = True

    def end(self) -> None:
        """Stop it after it has stored its data. May be called twice."""
        self.stop_restarting()
        if self.child is not None:
            self.child.end(_TIMEOUT)
            self.child = None
        self._shared.close()
