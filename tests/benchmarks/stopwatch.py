"""Times competitors in turn, A B C A B C ..., so that the machine's moods fall on all alike.

The clock is the thread's own processor time: what other programs take from the core does not count.
Everything timed here works in the calling thread.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

Work = Callable[[int], object]
"""Does its work n times over in one call."""

Times = NDArray[np.float64]
"""Nanoseconds for one piece of work, one figure a round."""


def nanoseconds(work: Work, n: int) -> float:
    """Return the time of one of `n` pieces of work (ns)."""
    start = time.thread_time_ns()
    work(n)
    return (time.thread_time_ns() - start) / n


def _repeats(work: Work, sample_ns: float) -> int:
    """Return how many pieces of `work` take about `sample_ns`."""
    work(1)  # compiles, allocates
    n = 1
    while (taken := min(nanoseconds(work, n) for _ in range(3)) * n) < sample_ns / 4:
        n *= 2
    return max(1, round(n * sample_ns / taken))


def in_turn(works: Mapping[str, Work], rounds: int = 25, sample_s: float = 0.01) -> dict[str, Times]:
    """Time each of `works` for about `sample_s`, `rounds` times in turn; the first calls warm up."""
    repeats = {name: _repeats(work, sample_s * 1e9) for name, work in works.items()}
    times: dict[str, list[float]] = {name: [] for name in works}
    collecting = gc.isenabled()
    gc.disable()
    try:
        for _ in range(rounds):
            for name, work in works.items():
                times[name].append(nanoseconds(work, repeats[name]))
    finally:
        if collecting:
            gc.enable()
    return {name: np.array(values) for name, values in times.items()}
