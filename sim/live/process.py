"""The software plant as a process of its own: it lives on the wall's clock, whatever becomes of the loop.

`python -m sim.live.process` takes a pickled PlantPlan on stdin and tells of itself with JSON lines on
stdout: "ready" once its code is warm and its files stand, "failed" with the reason, "stopped" with the
reason. It ends on SIGTERM, when another plant has taken its folder, or when the process that started it is
gone and no command has come for a while. Passive it runs on: the robot sinks, the chambers vent.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import pickle
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import DriverError
from drivers.base.compiled import new_record
from drivers.base.shared_record import SharedMemoryError, SharedRecord
from sim.live.exchange import (
    COMMAND_FILE,
    PLANT_COMMAND,
    PLANT_REPORT,
    PLANT_SURROUNDINGS,
    REPORT_FILE,
    SURROUNDINGS_FILE,
    PlantPlan,
)
from sim.live.wall_grid import WallGrid
from sim.live.wall_plant import WallPlant

_BETWEEN_LOOKS = 0.02
"""s between two looks at signals, parent and files."""
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_PR_SET_TIMERSLACK, _PR_SET_THP_DISABLE = 29, 41


# The side of the one who starts it -------------------------------------------------------------------


def start_plant(plan: PlantPlan, timeout: float = 180.0) -> subprocess.Popen[bytes]:
    """Start the plant's process and wait until it is ready; `timeout` (s) covers compiling everything.

    Its stdout stays open for later events. End it with `terminate()`, and `with` closes its pipes.

    Raises:
        DriverError: it failed, ended or was not ready in time; it runs no longer then.
    """
    # What this process can import, its child can; one BLAS thread, for every other one disturbs the timing.
    path = os.pathsep.join(dict.fromkeys([*filter(None, sys.path), str(Path(__file__).parents[2])]))
    environment = {**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "sim.live.process"],
        bufsize=0,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
    )
    try:
        _await_ready(process, plan, time.monotonic() + timeout)
    except BaseException:
        process.kill()
        with process:
            raise
    return process


def _await_ready(process: subprocess.Popen[bytes], plan: PlantPlan, deadline: float) -> None:
    if process.stdin is None or process.stdout is None:
        raise DriverError("plant process: it was started without pipes")
    with suppress(BrokenPipeError), process.stdin:  # should it be dead already, its stdout tells
        process.stdin.write(pickle.dumps(plan))
    heard = b""
    while True:
        *lines, rest = heard.split(b"\n")
        for event in filter(None, map(_event, lines)):
            if event["event"] == "ready":
                return
            raise DriverError(f"plant process: it told {event['event']!r}: {event.get('reason', '')}")
        heard = rest
        left = deadline - time.monotonic()
        if left <= 0.0 or not select.select([process.stdout], [], [], left)[0]:
            raise DriverError(
                "plant process: found it not ready in time, expected it to be; the first start compiles for "
                "about half a minute: start it again, with a NUMBA_CACHE_DIR that is kept"
            )
        new = os.read(process.stdout.fileno(), 4096)
        if not new:
            raise DriverError(
                f"plant process: it ended with exit code {process.wait()} before it was ready; see its stderr"
            )
        heard += new


def _event(line: bytes) -> dict[str, Any] | None:
    """Return the event told in `line`, None when it is no event."""
    with suppress(ValueError):
        event = json.loads(line)
        if isinstance(event, dict) and isinstance(event.get("event"), str):
            return event
    return None


# The process -----------------------------------------------------------------------------------------


def main() -> int:
    """Be the plant that the plan on stdin describes; return the exit code."""
    parent = os.getppid()
    for number in (signal.SIGINT, signal.SIGABRT):  # they go to all processes at once; the parent decides
        signal.signal(number, signal.SIG_IGN)
    try:
        plan = pickle.load(sys.stdin.buffer)  # noqa: S301 - the parent's own data
        if not isinstance(plan, PlantPlan):
            raise TypeError(f"plan: found {type(plan).__name__}, expected a PlantPlan")
        _warm_up(plan)
        plant = WallPlant(plan)
        with PlantFiles(plan.folder) as files:
            scheduling = ask_for_scheduling(plan)
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # looked for between ticks
            gc.collect()
            gc.freeze()
            gc.disable()
            tell("ready", pid=os.getpid(), scheduling=scheduling)
            reason = _live(plan, plant, files, lambda: _is_orphan(parent))
        tell("stopped", reason=reason)
        return 0
    except (ValueError, TypeError, pickle.UnpicklingError, EOFError, SharedMemoryError) as error:
        tell("failed", reason=f"{error}")
    except Exception as error:
        tell("failed", reason=f"{type(error).__name__}: {error}")
        raise
    return 1


class PlantFiles:
    """The three shared records, made in place of what a dead plant left, removed at the end."""

    def __init__(self, folder: Path) -> None:
        """Make them in `folder`; SharedMemoryError when that fails."""
        self._stack = ExitStack()
        self._paths: dict[Path, int] = {}
        try:
            self.command = self._make(folder / COMMAND_FILE, PLANT_COMMAND)
            self.surroundings = self._make(folder / SURROUNDINGS_FILE, PLANT_SURROUNDINGS)
            self.report = self._make(folder / REPORT_FILE, PLANT_REPORT)
        except BaseException:
            self.close()
            raise

    @property
    def are_there(self) -> bool:
        """They still lie in the folder: nobody removed or replaced them."""
        return all(_number(path) == number for path, number in self._paths.items())

    def close(self) -> None:
        """Unmap and remove them, but not those of a successor."""
        self._stack.close()

    def __enter__(self) -> PlantFiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _make(self, path: Path, dtype: np.dtype[Any]) -> SharedRecord:
        with suppress(OSError):  # a folder that cannot be written shows in the next line
            path.unlink(missing_ok=True)
        record = SharedRecord.create(path, dtype)
        self._paths[path] = _number(path)
        self._stack.callback(self._remove, path)
        self._stack.callback(record.close)
        return record

    def _remove(self, path: Path) -> None:
        if _number(path) == self._paths[path]:
            path.unlink(missing_ok=True)


def _number(path: Path) -> int:
    """Return the inode at `path`, 0 when there is none."""
    try:
        return path.stat().st_ino
    except OSError:
        return 0


def _warm_up(plan: PlantPlan) -> None:
    """Call everything once that a tick calls, on a plant of its own."""
    plant = WallPlant(plan)
    plant.hear(new_record(PLANT_COMMAND))
    plant.surround(new_record(PLANT_SURROUNDINGS))
    plant.move(plan.plant.tick)
    plant.tell()


def ask_for_scheduling(plan: PlantPlan) -> str:
    """Ask for the plan's core and priority; return what was granted."""
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # ns; by default a sleep may last 50 us longer
    granted = []
    if plan.cpu >= 0:
        with suppress(OSError):
            os.sched_setaffinity(0, {plan.cpu})
    if plan.priority > 0:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(plan.priority))
    is_fifo = os.sched_getscheduler(0) == os.SCHED_FIFO
    granted.append(f"SCHED_FIFO {os.sched_getparam(0).sched_priority}" if is_fifo else "SCHED_OTHER")
    # All stays in memory, where it is: a page fetched from disk in a tick is a stall of milliseconds, small
    # pages gathered into a huge one are a stall of one.
    ctypes.CDLL(None).prctl(_PR_SET_THP_DISABLE, 1, 0, 0, 0)
    locked = ctypes.CDLL(None).mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0
    granted.append("memory locked" if locked else "memory not locked")
    granted.append("cpu " + ",".join(map(str, sorted(os.sched_getaffinity(0)))))
    return ", ".join(granted)


def _live(plan: PlantPlan, plant: WallPlant, files: PlantFiles, is_orphan: Callable[[], bool]) -> str:
    """Run the plant on the wall's clock; return why it ended."""
    command, surroundings = new_record(PLANT_COMMAND), new_record(PLANT_SURROUNDINGS)
    report = plant.report
    clock, sleep = time.monotonic, time.sleep
    heard_counter, heard_time = 0, clock()
    looked, surrounded = 0.0, 0
    grid = WallGrid(plan.plant.tick, clock(), plan.burst)
    while True:
        now = clock()
        early = grid.instant - now
        if early > 0.0:
            sleep(early)
            continue
        due = grid.take_due(now)
        if files.command.read(command):
            plant.hear(command)
        if (version := files.surroundings.read(surroundings)) != surrounded:
            surrounded = version
            plant.surround(surroundings)
        for _ in range(due):
            plant.move(grid.instant)
            grid.line += 1
        plant.tell()
        report["lateness"] = -early
        report["greatest_lateness"] = max(report["greatest_lateness"][0], -early)
        report["plant_slips"], report["slipped_ticks"] = grid.slips, grid.slipped_ticks
        files.report.write(report)
        if now - looked > _BETWEEN_LOOKS:
            looked = now
            if plant.node.counter != heard_counter:
                heard_counter, heard_time = plant.node.counter, now
            if signal.SIGTERM in signal.sigpending():
                return "SIGTERM"
            if not files.are_there:
                return "another plant took the folder, or its files were removed"
            if now - heard_time > plan.lonely and is_orphan():
                return f"its parent is gone and no command has come for {plan.lonely:g} s"


def _is_orphan(parent: int) -> bool:
    return os.getppid() != parent


def tell(event: str, **fields: object) -> None:
    """Tell the parent, if it still listens."""
    with suppress(OSError):
        sys.stdout.write(json.dumps({"event": event, **fields}) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
