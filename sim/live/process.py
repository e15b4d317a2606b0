"""The plant process: simulates the plant in wall-clock time, independent of the loop.

`python -m sim.live.process` reads a pickled PlantPlan on stdin and reports JSON lines on stdout: "ready" once
its code is compiled and its files exist, "failed" with the reason, "stopped" with the reason. It ends on
SIGTERM, when another plant has taken its folder, or when its parent is gone and no command has come for a
while. While passive it keeps running: the robot sinks, the chambers vent.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base.compile_report import announce_compilation
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

_POLL_PERIOD = 0.02
"""Polling period of signals, parent and files, s."""
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_PR_SET_TIMERSLACK, _PR_SET_THP_DISABLE = 29, 41


def main() -> int:
    """Run the plant of the plan on stdin; return the exit code."""
    parent = os.getppid()
    for number in (signal.SIGINT, signal.SIGABRT):  # sent to the whole process group; the parent decides
        signal.signal(number, signal.SIG_IGN)
    try:
        announce_compilation(lambda text: send_event("compiling", text=text))
        plan = pickle.load(sys.stdin.buffer)  # noqa: S301 - the parent's own data
        if not isinstance(plan, PlantPlan):
            raise TypeError(f"plan: found {type(plan).__name__}, expected a PlantPlan")
        _warm_up(plan)
        plant = WallPlant(plan)
        with PlantFiles(plan.folder) as files:
            scheduling = ask_for_scheduling(plan)
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # polled between ticks
            gc.collect()
            gc.freeze()
            gc.disable()
            send_event("ready", pid=os.getpid(), scheduling=scheduling)
            reason = _live(plan, plant, files, lambda: _is_orphan(parent))
        send_event("stopped", reason=reason)
        return 0
    except (ValueError, TypeError, pickle.UnpicklingError, EOFError, SharedMemoryError) as error:
        send_event("failed", reason=f"{error}")
    except Exception as error:
        send_event("failed", reason=f"{type(error).__name__}: {error}")
        raise
    return 1


class PlantFiles:
    """The three shared records; stale ones are replaced, and the files are removed at the end."""

    def __init__(self, folder: Path) -> None:
        """Create the files in `folder`; SharedMemoryError on failure."""
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
        """Whether the files still exist and have not been replaced."""
        return all(_number(path) == number for path, number in self._paths.items())

    def close(self) -> None:
        """Unmap and remove the files, but not those of a successor."""
        self._stack.close()

    def __enter__(self) -> PlantFiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _make(self, path: Path, dtype: np.dtype[Any]) -> SharedRecord:
        with suppress(OSError):  # an unwritable folder fails in the next line
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
    """Return the inode at `path`, 0 if missing."""
    try:
        return path.stat().st_ino
    except OSError:
        return 0


def _warm_up(plan: PlantPlan) -> None:
    """Call every function of a tick once, on a separate plant."""
    plant = WallPlant(plan)
    plant.receive(new_record(PLANT_COMMAND))
    plant.set_surroundings(new_record(PLANT_SURROUNDINGS))
    plant.move(plan.plant.tick)
    plant.update_report()


def ask_for_scheduling(plan: PlantPlan) -> str:
    """Request the plan's core and priority; return what was granted."""
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # 1 ns; by default a sleep may last 50 us longer
    granted = []
    if plan.cpu >= 0:
        with suppress(OSError):
            os.sched_setaffinity(0, {plan.cpu})
    if plan.priority > 0:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(plan.priority))
    is_fifo = os.sched_getscheduler(0) == os.SCHED_FIFO
    granted.append(f"SCHED_FIFO {os.sched_getparam(0).sched_priority}" if is_fifo else "SCHED_OTHER")
    # Lock all memory: a page fault from disk stalls a tick for milliseconds, collapsing small pages into a
    # huge one for one millisecond.
    ctypes.CDLL(None).prctl(_PR_SET_THP_DISABLE, 1, 0, 0, 0)
    locked = ctypes.CDLL(None).mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0
    granted.append("memory locked" if locked else "memory not locked")
    granted.append("cpu " + ",".join(map(str, sorted(os.sched_getaffinity(0)))))
    return ", ".join(granted)


def _live(plan: PlantPlan, plant: WallPlant, files: PlantFiles, is_orphan: Callable[[], bool]) -> str:
    """Run the plant in wall-clock time; return why it ended."""
    command, surroundings = new_record(PLANT_COMMAND), new_record(PLANT_SURROUNDINGS)
    report = plant.report
    clock, sleep = time.monotonic, time.sleep
    last_counter, last_command_time = 0, clock()
    looked, surrounded = 0.0, 0
    grid = WallGrid(plan.plant.tick, clock(), plan.max_catch_up)
    while True:
        now = clock()
        early = grid.instant - now
        if early > 0.0:
            sleep(early)
            continue
        due = grid.take_due(now)
        if files.command.read(command):
            plant.receive(command)
        if (version := files.surroundings.read(surroundings)) != surrounded:
            surrounded = version
            plant.set_surroundings(surroundings)
        for _ in range(due):
            plant.move(grid.instant)
            grid.line += 1
        plant.update_report()
        report["lateness"] = -early
        report["max_lateness"] = max(report["max_lateness"][0], -early)
        report["plant_slips"], report["slipped_ticks"] = grid.slips, grid.slipped_ticks
        files.report.write(report)
        if now - looked > _POLL_PERIOD:
            looked = now
            if plant.node.counter != last_counter:
                last_counter, last_command_time = plant.node.counter, now
            if signal.SIGTERM in signal.sigpending():
                return "SIGTERM"
            if not files.are_there:
                return "another plant took the folder, or its files were removed"
            if now - last_command_time > plan.orphan_timeout and is_orphan():
                return f"its parent is gone and no command has come for {plan.orphan_timeout:g} s"


def _is_orphan(parent: int) -> bool:
    return os.getppid() != parent


def send_event(event: str, **fields: object) -> None:
    """Send an event to the parent, if it still reads."""
    with suppress(OSError):
        sys.stdout.write(json.dumps({"event": event, **fields}) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
