"""Compile the decision of the control step, half of all compiled code, in another process.

`python -m bench.loop.compile_ahead PARENT` is that process; PARENT finds its machine code on disk. Where
several processes need it at one time, the first compiles it.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from bench.base.process import end_with, import_path
from bench.control.step import decide_tick, estimate_tick, limit_tick
from bench.control.step_records import new_control_state
from bench.loop._compiled_tick import empty_parameters
from bench.records.telemetry.cycle_record import CYCLE
from drivers.base.compile_report import announce_compilation, report_compilation
from drivers.base.compiled import IS_PLAIN, new_record
from drivers.base.kept_code import compile_for, is_kept
from drivers.base.machine_code import cache_folder
from drivers.base.records import COMMAND, READINGS

_POLL_PERIOD = 2.5
"""Time between two reports while the other process still compiles, s."""
_TIMEOUT = 600.0
"""Max time of the compilation in the other process, s."""


@contextmanager
def compile_ahead() -> Iterator[bool]:
    """Compile the whole step: the decision in another process during the block, the rest before the block.

    The block gets whether this is done, at most once in a process: not where the machine code is on disk,
    there is one processor only, this is a worker of several, or the system is not Linux. Where the other
    process fails or takes too long, the first tick compiles the decision.
    """
    other = _other_process()
    if other is None or other.poll() is not None:
        yield False
        return
    begin = time.monotonic()
    try:
        compile_rest()
        yield True
        while other.poll() is None and (seconds := time.monotonic() - begin) < _TIMEOUT:
            try:
                other.wait(_POLL_PERIOD)
            except subprocess.TimeoutExpired:
                report_compilation(f"compiling the control step, once for each version: {seconds:.0f} s")
    finally:
        other.kill()
        other.wait()


@cache
def _other_process() -> subprocess.Popen[bytes] | None:
    """Return the process that compiles the decision, started once; None where this one compiles all."""
    if IS_PLAIN or sys.platform != "linux" or multiprocessing.parent_process() is not None:
        return None
    if len(os.sched_getaffinity(0)) < 2 or is_kept(decide_tick):
        return None
    quiet = subprocess.DEVNULL
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "bench.loop.compile_ahead", str(os.getpid())],
            env={**os.environ, "PYTHONPATH": import_path()},
            stdin=quiet,
            stdout=quiet,  # a pipe behind the parent's must not wait for this process
            stderr=quiet,
        )
    except OSError:
        return None


def compile_rest() -> None:
    """Compile the estimation and the limits of the control step."""
    state, parameters, readings = new_control_state(), empty_parameters(), new_record(READINGS)
    compile_for(estimate_tick, state, parameters, readings, 0.0)
    compile_for(limit_tick, state, parameters, readings, new_record(COMMAND), new_record(CYCLE))


def compile_decision() -> None:
    """Compile the decision, unless its machine code is on disk; other processes wait for the first."""
    import fcntl  # here, for this module is imported on systems without it too

    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "decision.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not is_kept(decide_tick):
            compile_for(decide_tick, new_control_state(), empty_parameters(), new_record(READINGS), 0.0)


def main(parent: int) -> None:
    """Compile the decision; end with the process `parent`, that has started this one and reports."""
    end_with(parent)
    announce_compilation(str)
    compile_decision()


if __name__ == "__main__":
    main(int(sys.argv[1]))
