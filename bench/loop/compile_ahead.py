"""Compile the decision of the control step, half of all compiled code, in another process.

`python -m bench.loop.compile_ahead` is that process. Its machine code is kept on disk, where the process that
has started it finds it. Processes that need it at one time, like workers, compile it once.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache

from bench.control.step import decide_tick, estimate_tick, limit_tick
from bench.control.step_records import new_control_state
from bench.loop.compiled_tick import empty_parameters
from bench.records.telemetry.cycle_record import CYCLE
from drivers.base.compile_report import announce_compilation, report_compilation
from drivers.base.compiled import IS_PLAIN, new_record
from drivers.base.kept_code import compile_for, is_kept
from drivers.base.machine_code import cache_folder
from drivers.base.records import COMMAND, READINGS

_POLL_PERIOD = 2.5
"""Time between two reports while the other process still compiles, s."""


@contextmanager
def compile_ahead() -> Iterator[bool]:
    """Compile the whole step: the decision in another process during the block, the rest before the block.

    The block gets whether this is done: not where the machine code is on disk or there is one processor only.
    Where the other process fails, the first tick compiles the decision.
    """
    if not _needed():
        yield False
        return
    begin = time.monotonic()
    command = [sys.executable, "-P", "-m", "bench.loop.compile_ahead"]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as other:
        try:
            compile_rest()
            yield True
            while other.poll() is None:
                with suppress(subprocess.TimeoutExpired):
                    other.wait(_POLL_PERIOD)
                seconds = time.monotonic() - begin
                report_compilation(f"compiling the control step, once for each version: {seconds:.0f} s")
        finally:
            other.terminate()


@cache
def _needed() -> bool:
    """Return whether this process is the first to run the step, with processors for two."""
    return not IS_PLAIN and len(os.sched_getaffinity(0)) > 1 and not is_kept(decide_tick)


def compile_rest() -> None:
    """Compile estimation and limits of the step."""
    state, parameters, readings = new_control_state(), empty_parameters(), new_record(READINGS)
    compile_for(estimate_tick, state, parameters, readings, 0.0)
    compile_for(limit_tick, state, parameters, readings, new_record(COMMAND), new_record(CYCLE))


def compile_decision() -> None:
    """Compile the decision, unless it is on disk; other processes that need it wait for the first."""
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "decision.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not is_kept(decide_tick):
            compile_for(decide_tick, new_control_state(), empty_parameters(), new_record(READINGS), 0.0)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    announce_compilation(str)  # its parent reports
    compile_decision()
