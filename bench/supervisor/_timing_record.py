"""The loop's timing as any process reads it: the layout of its counters, their reader and their statistics.

The loop writes them, see `bench.supervisor._tick_timing`. They are 8-byte counters in a mapped file that only
grow: any process may read at any time, and the difference of two snapshots covers the time between. A
snapshot may be off by one tick, but is never torn: a processor stores an aligned word atomically. The
histograms are log-linear: sixteen buckets an octave, so a percentile is known within a sixteenth, from 256 ns
to 134 ms.
"""

from __future__ import annotations

from enum import IntEnum
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.base.shared_memory import SharedMemoryError

STAMPS = ("begin", "read", "estimate", "decide", "limit", "write", "publish")
"""Time stamps of a tick (ns, CLOCK_MONOTONIC): its start, then the end of each segment."""

SEGMENTS = ("wake_up", "orders", *STAMPS[1:], "tick")
"""Histograms: grid point to wake-up, wake-up to begin, each segment, wake-up to the end of the last."""

PER_OCTAVE = 16
FIRST_OCTAVE, LAST_OCTAVE = 8, 27
"""Powers of two: durations below 256 ns share the first bucket, those from 134 ms on the last."""
BUCKETS = 2 + PER_OCTAVE * (LAST_OCTAVE - FIRST_OCTAVE)


LATE = 1_000_000
"""Delay after which a tick counts as late, ns."""


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
`skipped` grid points without a tick; `late` ticks that woke more than LATE after theirs;
`page_faults` and `preemptions` of the loop's thread; `stalls` by why: ticks that were late or followed
skipped grid points."""

LAYOUT = int.from_bytes(sha256(repr((TIMING.descr, BUCKETS)).encode()).digest()[:7], "little")
"""Identifies this layout in the file."""


def upper_edges() -> NDArray[np.int64]:
    """Return the upper bounds (ns) of the buckets; that of the last is the int64 maximum."""
    octaves = np.arange(FIRST_OCTAVE, LAST_OCTAVE)[:, None]
    inner = 2**octaves + 2**octaves // PER_OCTAVE * np.arange(1, PER_OCTAVE + 1)
    return np.concatenate([[1 << FIRST_OCTAVE], inner.ravel(), [np.iinfo(np.int64).max]])


class TimingReader:
    """Reader of the counters, for any process."""

    def __init__(self, path: Path) -> None:
        """Map the file at `path`.

        Raises:
            SharedMemoryError: the file is missing, or has another layout.
        """
        try:
            self._counters = np.memmap(path, TIMING, "r", shape=1)
            if (layout := int(self._counters["layout"][0])) == LAYOUT:
                return
            found = f"layout {layout}"
        except (OSError, ValueError) as error:
            found = getattr(error, "strerror", None) or str(error)
        raise SharedMemoryError(
            str(path),
            found,
            f"the loop's timing: {TIMING.itemsize} bytes, layout {LAYOUT}",
            "Restart all processes of the bench from one installation.",
        )

    def snapshot(self) -> np.ndarray[Any, Any]:
        """Return a copy of the counters, a one-element array of TIMING."""
        return np.frombuffer(self._counters.tobytes(), TIMING)


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
