"""Loop timing: counts wake-up latencies and the segments of the ticks.

Constant memory, one small compiled call a tick. Layout and reader: `bench.supervisor._timing_record`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.supervisor._timing_record import (
    BUCKETS,
    LATE,
    LAYOUT,
    SEGMENTS,
    STAMPS,
    TIMING,
    Stall,
    upper_edges,
)
from drivers.base.compiled import compiled
from drivers.base.shared_memory import SharedMemoryError

_PERIOD, _TICKS, _SKIPPED, _LATE, _DUE, _MAX_DURATION, _COUNT = (
    int(TIMING.fields[name][1]) // 8  # type: ignore[index]
    for name in ("period", "ticks", "skipped", "late", "due", "longest", "count")
)
"""Offsets of the fields in the record as a vector of words."""
_TICK = len(SEGMENTS) - 1
_EDGES = upper_edges()

BUDGET = 0.8
"""Max share of the period for a tick; the rest is reserve for disturbances by the machine."""
_TYPICAL = 0.9
"""Share of ticks that must meet the budget. A stall of the machine affects single ticks, is counted while the
loop runs, and does not depend on the configuration."""
_ACTIONS = {
    "read": "check the driver's read: too many nodes, or too low a bit rate",
    "write": "check the driver's write: too many nodes, or too low a bit rate",
    "publish": "check the ring's folder: it must be in memory",
}
_COMPILED_ACTION = "check that NUMBA_DISABLE_JIT is not set: the numerics must run compiled"


@compiled
def _count(words: Any, segment: int, duration: int) -> None:
    above, end = 0, len(_EDGES)  # np.searchsorted would take numba a second
    while above < end:
        middle = (above + end) // 2
        if _EDGES[middle] <= duration:
            above = middle + 1
        else:
            end = middle
    words[_COUNT + segment * BUCKETS + above] += 1
    words[_MAX_DURATION + segment] = max(words[_MAX_DURATION + segment], duration)


@compiled
def _note(words: Any, marks: Any, due: int, woke: int) -> int:
    """Count one tick into `words`, a TIMING record as a vector; return its delay (ns), 0 unless a stall."""
    latency, period = woke - due, words[_PERIOD]
    _count(words, 0, latency)
    _count(words, 1, marks[0] - woke)
    for k in range(1, len(marks)):
        _count(words, k + 1, marks[k] - marks[k - 1])
    _count(words, _TICK, marks[len(marks) - 1] - woke)
    words[_TICKS] += 1
    missed = 0
    if latency > LATE:
        words[_LATE] += 1
    if words[_DUE] > 0 and period > 0:
        missed = (due - words[_DUE]) // period - 1
        words[_SKIPPED] += missed
    words[_DUE] = due
    return latency + missed * period if missed > 0 or latency > LATE else 0


class TickTiming:
    """The loop's side: counts its ticks into a TIMING record."""

    def __init__(self, record: np.ndarray[Any, Any]) -> None:
        """Count into `record`, a one-element array of TIMING, which may be in a mapped file."""
        self._record, self._words = record, record.view(np.int64)

    def note(self, marks: NDArray[np.int64], due: int, woke: int) -> int:
        """Count a tick with its due and wake-up times (ns); `marks` are its STAMPS. Takes about 1 us.

        Return the delay of a stall, including the grid points skipped before it (ns); 0 without a stall.
        """
        return _note(self._words, marks, due, woke)

    def note_usage(self, page_faults: int, preemptions: int) -> None:
        """Set the counters of the loop's thread since it became ready."""
        self._record["page_faults"], self._record["preemptions"] = page_faults, preemptions

    def note_stall(self, stall: Stall) -> None:
        """Count a stall."""
        self._record["stalls"][0, stall] += 1

    def close(self) -> None:
        """Unmap; the file remains. May be called twice."""
        self._record = np.zeros(1, TIMING)
        self._words = self._record.view(np.int64)


def new_timing(period_ns: int) -> np.ndarray[Any, Any]:
    """Return a TIMING record (one-element array) of a loop of `period_ns` that has not run yet."""
    record = np.zeros(1, TIMING)
    record["layout"], record["period"] = LAYOUT, period_ns
    return record


def create_timing(path: Path, period_ns: int) -> TickTiming:
    """Create the file of a loop of `period_ns` at `path`, readable by its owner only, and return its counter.

    Raises:
        SharedMemoryError: `path` exists, or its folder is missing, read-only or full.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with open(descriptor, "r+b") as file:
            os.posix_fallocate(descriptor, 0, TIMING.itemsize)  # a full folder fails here, not in a tick
            record = np.memmap(file, TIMING, shape=1)
    except OSError as error:
        raise SharedMemoryError(
            str(path),
            error.strerror or str(error),
            f"a folder in memory without a file of that name, with {TIMING.itemsize} bytes left",
            "Create the folder, free some of its memory, or remove the file if no process uses it.",
        ) from error
    record["period"] = period_ns
    record["layout"] = LAYOUT  # last: a reader that opens earlier finds the file not ready
    return TickTiming(record.view(np.ndarray))


def check_budget(stamps: NDArray[np.int64], period_ns: int) -> None:
    """Check the ticks against the budget of their period.

    `stamps` (n, 7) ns are the STAMPS of measured ticks: nine of ten must meet BUDGET.

    Raises:
        Refused: the budget is exceeded, with the longest segment and the action.
        ValueError: there are no ticks.
    """
    if not len(stamps):
        raise ValueError("the budget of no ticks")
    tick = float(np.quantile(stamps[:, -1] - stamps[:, 0], _TYPICAL, method="higher"))
    if tick <= BUDGET * period_ns:
        return
    cost = np.median(np.diff(stamps, axis=1), axis=0)
    worst = int(np.argmax(cost))
    name = STAMPS[1 + worst]
    raise Refused(
        "loop.rate",
        f"{1e9 / period_ns:.5g} Hz, with ticks of {tick / 1000:.0f} µs ({_TYPICAL:.0%} of {len(stamps)} are "
        f"shorter), {tick / period_ns:.0%} of the period; {name!r} is longest, {cost[worst] / 1000:.0f} µs",
        f"at most {BUDGET:.0%} of the period, {BUDGET * period_ns / 1000:.0f} µs",
        f"Set loop.rate to at most {int(1e9 * BUDGET / tick)} Hz, or {_ACTIONS.get(name, _COMPILED_ACTION)}.",
    )
