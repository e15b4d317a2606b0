"""Loop timing: histograms of wake-up latency and of the segments of the ticks.

Constant memory, one small compiled call a tick. The histograms are log-linear: sixteen buckets an octave, so
a percentile is known within a sixteenth, from 256 ns to 134 ms. They are in a mapped file of 8-byte counters
that only grow: the loop counts, any process may read at any time, and the difference of two snapshots covers
the time between. A snapshot may be off by one tick, but is never torn: a processor stores an aligned word
atomically.
"""

from __future__ import annotations

import mmap
import os
from enum import IntEnum
from hashlib import sha256
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bench.clock import LATE
from bench.errors import Refused
from drivers.base.compiled import compiled
from drivers.base.mapped_slots import SharedMemoryError

STAMPS = ("begin", "read", "estimate", "decide", "limit", "write", "publish")
"""Time stamps of a tick (ns, CLOCK_MONOTONIC): its begin, then the end of each segment."""

SEGMENTS = ("wake_up", "orders", *STAMPS[1:], "tick")
"""Histograms: grid point to wake-up, wake-up to begin, each segment, wake-up to the end of the last."""

_PER_OCTAVE = 16
_FIRST_OCTAVE, _LAST_OCTAVE = 8, 27
"""Powers of two: durations below 256 ns share the first bucket, those from 134 ms on the last."""
BUCKETS = 2 + _PER_OCTAVE * (_LAST_OCTAVE - _FIRST_OCTAVE)


class Stall(IntEnum):
    """Why a tick was late, or grid points had none."""

    PREEMPTION = 0
    """Other threads had its core."""
    PAGE_FAULT = 1
    LONG_TICK = 2
    """The tick before took longer than a period."""
    MACHINE = 3
    """None of these: the hypervisor's stolen time, interrupts, firmware."""


TIMING = np.dtype(
    [
        ("layout", "i8"),
        ("period", "i8"),
        ("ticks", "i8"),
        ("skipped", "i8"),
        ("late", "i8"),
        ("page_faults", "i8"),
        ("preemptions", "i8"),
        ("stalls", "i8", (len(Stall),)),
        ("due", "i8"),
        ("longest", "i8", (len(SEGMENTS),)),
        ("count", "i8", (len(SEGMENTS), BUCKETS)),
    ]
)
"""Counters since the loop's start. `period`, `due` (grid point of the last tick) and `longest` in ns;
`skipped` grid points without a tick; `late` ticks that woke more than `bench.clock.LATE` after theirs;
`page_faults` and `preemptions` of the loop's thread; `stalls` by why: ticks that were late or followed
skipped grid points."""

_LAYOUT = int.from_bytes(sha256(repr((TIMING.descr, BUCKETS)).encode()).digest()[:7], "little")
_PERIOD, _TICKS, _SKIPPED, _LATE, _DUE, _LONGEST, _COUNT = (
    int(TIMING.fields[name][1]) // 8  # type: ignore[index]
    for name in ("period", "ticks", "skipped", "late", "due", "longest", "count")
)
"""Offsets of the fields in the record as a vector of words."""
_TICK = len(SEGMENTS) - 1

BUDGET = 0.8
"""Max share of the period for a tick; the rest is reserve for disturbances by the machine."""
_TYPICAL = 0.9
"""Share of ticks that must meet the budget. A stall of the machine affects single ticks, is counted while the
loop runs, and does not depend on the configuration."""
_CURES = {
    "read": "check the driver's read: too many nodes, or too low a bit rate",
    "write": "check the driver's write: too many nodes, or too low a bit rate",
    "publish": "check the ring's folder: it must be in memory",
}
_COMPILED_CURE = "check that NUMBA_DISABLE_JIT is not set: the numerics must run compiled"


@compiled
def bucket(duration: int) -> int:
    """Return the bucket of `duration` (ns)."""
    if duration < 1 << _FIRST_OCTAVE:
        return 0
    if duration >= 1 << _LAST_OCTAVE:
        return BUCKETS - 1
    octave = _FIRST_OCTAVE
    while duration >= 2 << octave:
        octave += 1
    return (
        1 + (octave - _FIRST_OCTAVE) * _PER_OCTAVE + (duration - (1 << octave)) * _PER_OCTAVE // (1 << octave)
    )


@compiled
def _count(words: Any, segment: int, duration: int) -> None:
    words[_COUNT + segment * BUCKETS + bucket(duration)] += 1
    words[_LONGEST + segment] = max(words[_LONGEST + segment], duration)


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


def upper_edges() -> NDArray[np.int64]:
    """Return the upper bounds (ns) of the buckets; that of the last is the int64 maximum."""
    octaves = np.arange(_FIRST_OCTAVE, _LAST_OCTAVE)[:, None]
    inner = 2**octaves + 2**octaves // _PER_OCTAVE * np.arange(1, _PER_OCTAVE + 1)
    return np.concatenate([[1 << _FIRST_OCTAVE], inner.ravel(), [np.iinfo(np.int64).max]])


class TickTiming:
    """The loop's side: counts its ticks into a TIMING record."""

    def __init__(self, record: np.ndarray[Any, Any], memory: mmap.mmap | None = None) -> None:
        """Count into `record`, a one-element array of TIMING, which may be in `memory`."""
        self._record, self._words = record, record.view(np.int64)
        self._memory = memory

    def note(self, marks: NDArray[np.int64], due: int, woke: int) -> int:
        """Count a tick with its due and wake-up times (ns); `marks` are its STAMPS. Takes about 1 us.

        Return by how much it was late (ns), with the grid points skipped before it; 0 unless that is a stall.
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
        if self._memory is not None:
            self._memory.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def new_timing(period_ns: int) -> np.ndarray[Any, Any]:
    """Return a TIMING record (one-element array) of a loop of `period_ns` that has not run yet."""
    record = np.zeros(1, TIMING)
    record["layout"], record["period"] = _LAYOUT, period_ns
    return record


def create_timing(path: Path, period_ns: int) -> TickTiming:
    """Create the file of a loop of `period_ns` at `path`, readable by its owner only, and return its counter.

    Raises:
        SharedMemoryError: `path` exists, or its folder is missing, read-only or full.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, TIMING.itemsize)  # a full folder fails here, not in a tick
            memory = mmap.mmap(descriptor, TIMING.itemsize)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise SharedMemoryError(
            str(path),
            error.strerror or str(error),
            f"a folder in memory without a file of that name, with {TIMING.itemsize} bytes left",
            "Create the folder, free some of its memory, or remove the file if no process uses it.",
        ) from error
    record = np.frombuffer(memory, TIMING)
    record["period"] = period_ns
    record["layout"] = _LAYOUT  # last: a reader that opens earlier finds the file not ready
    return TickTiming(record, memory)


class TimingReader:
    """Reader of the counters, for any process."""

    def __init__(self, path: Path) -> None:
        """Map the file at `path`.

        Raises:
            SharedMemoryError: the file is missing, or has another layout.
        """
        found = "no such file"
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            try:
                size = os.fstat(descriptor).st_size
                found = f"{size} bytes"
                if size == TIMING.itemsize:
                    self._memory = mmap.mmap(descriptor, size, prot=mmap.PROT_READ)
                    layout = int(self.snapshot()["layout"][0])
                    if layout == _LAYOUT:
                        return
                    found = f"layout {layout}"
                    self._memory.close()
            finally:
                os.close(descriptor)
        except OSError as error:
            found = error.strerror or str(error)
        raise SharedMemoryError(
            str(path),
            found,
            f"the loop's timing: {TIMING.itemsize} bytes, layout {_LAYOUT}",
            "Restart all processes of the bench from one installation.",
        )

    def snapshot(self) -> np.ndarray[Any, Any]:
        """Return a copy of the counters, a one-element array of TIMING."""
        return np.frombuffer(self._memory[:], TIMING)

    def close(self) -> None:
        """Unmap; the file remains. May be called twice."""
        self._memory.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def percentile(count: NDArray[np.int64], share: float) -> int:
    """Return the `share` percentile (ns) of the durations in buckets `count`.

    Rounded up to the bucket's edge, by at most a sixteenth.

    Raises:
        ValueError: nothing was counted.
    """
    total = int(count.sum())
    if not total:
        raise ValueError("a percentile of no durations")
    rank = max(1, int(np.ceil(share * total - 1e-9)))
    return int(upper_edges()[np.searchsorted(np.cumsum(count), rank)])


def summary(now: np.ndarray[Any, Any], before: np.ndarray[Any, Any] | None = None) -> dict[str, Any]:
    """Return the statistics between two snapshots, or since the loop's start, as plain values.

    `ticks`, `skipped`, `late`, `page_faults`, `preemptions`, `stalls` by why, `period_us`, and by segment
    `count`, `p50_us`, `p99_us`, `p999_us`, `max_us`, None if nothing was counted. Percentiles are exact to
    within a sixteenth; so is the maximum, unless it is a new overall maximum, which is exact.
    """
    after = now[0]
    start = np.zeros(1, TIMING)[0] if before is None else before[0]
    counters = "ticks", "skipped", "late", "page_faults", "preemptions"
    answer: dict[str, Any] = {name: int(after[name] - start[name]) for name in counters}
    answer["stalls"] = {why.name.lower(): int(after["stalls"][why] - start["stalls"][why]) for why in Stall}
    answer["period_us"] = int(after["period"]) / 1000
    answer["segments"] = {}
    for segment, name in enumerate(SEGMENTS):
        count = after["count"][segment] - start["count"][segment]
        longest = int(after["longest"][segment])
        figures: dict[str, Any] = {"count": int(count.sum())}
        shares = {"p50_us": 0.5, "p99_us": 0.99, "p999_us": 0.999, "max_us": 1.0}
        for key, share in shares.items():
            is_new = share == 1.0 and longest > start["longest"][segment]
            known = (
                longest if is_new else min(percentile(count, share), longest) if figures["count"] else None
            )
            figures[key] = None if known is None else known / 1000
        answer["segments"][name] = figures
    return answer


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
        f"Set loop.rate to at most {int(1e9 * BUDGET / tick)} Hz, or {_CURES.get(name, _COMPILED_CURE)}.",
    )
