"""The benchmark of the loop's timing reads, pools and judges its figures right."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from bench.supervisor._tick_timing import TickTiming, new_timing
from tests.benchmarks.loop_timing import (
    HISTOGRAM_US,
    Latencies,
    LoopRun,
    Pair,
    median_interval,
    read_histogram,
    rows,
    run_cyclictest,
    steal_ticks,
    table,
)

OUTPUT = """# /dev/cpu_dma_latency set to 0us
# Histogram
000000 000000
000007 000900
000020 000080
000999 000010
001000 000009
# Total: 000000999
# Min Latencies: 00007
# Avg Latencies: 00010
# Max Latencies: 25000
# Histogram Overflows: 00001
# Histogram Overflow at cycle number:
# Thread 0: 00500
"""


def test_read_histogram_counts_overflows() -> None:
    found = read_histogram(OUTPUT)
    assert found == Latencies(1000, p50=8.0, p99=1000.0, p999=1001.0, longest=25001.0, late=10)


def test_read_histogram_overflow_counts_above_last_bin() -> None:
    found = read_histogram("# Max Latencies: 30000\n# Histogram Overflows: 3\n000005 000001\n")
    assert found.p50 == HISTOGRAM_US + 1
    assert found.late == 3


def test_read_histogram_empty_output_raises() -> None:
    with pytest.raises(RuntimeError, match="counted nothing"):
        read_histogram("# Total: 0\n")


@pytest.mark.requires("cyclictest")
def test_run_cyclictest_returns_ordered_latencies() -> None:
    ask = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    if subprocess.run([sys.executable, "-c", ask], check=False, stderr=subprocess.DEVNULL).returncode:
        pytest.skip("no real-time scheduling for this user")
    found = run_cyclictest(seconds=1, interval_us=2000, priority=1, cpu=min(os.sched_getaffinity(0)))
    assert 0 < found.wake_ups <= 501
    assert 0.0 < found.p50 <= found.p99 <= found.p999 <= found.longest


def test_steal_ticks_reads_selected_core() -> None:
    stat = "cpu  1 2 3 4 5 6 7 99 9 10\ncpu0 1 2 3 4 5 6 7 8 9 10\ncpu1 1 2 3 4 5 6 7 18 9 10\n"
    assert (steal_ticks(0, stat), steal_ticks(1, stat)) == (8, 18)


def latencies(p50: float, p99: float, p999: float, late: int = 0) -> Latencies:
    return Latencies(15_000, p50, p99, p999, 10 * p999, late)


def pair(factor: float, late: int = 0, steal: int = 0) -> Pair:
    run = LoopRun(latencies(10 * factor, 40 * factor, 200 * factor, late), 0, 100.0, 3, 0, steal)
    return Pair("loop", run, latencies(10, 40, 200, late=1), 0)


def counters(tick: int) -> np.ndarray:
    record = new_timing(1_000_000)
    marks = np.cumsum([10**9, *[tick // 6] * 6])
    TickTiming(record).note(marks, 10**9, 10**9)
    return record


def verdicts(pairs: list[Pair], tick: int = 60_000, rate: float = 1000.0) -> dict[str, bool]:
    return {row.name: row.holds for row in rows(pairs, counters(tick), rate)}


def test_timing_rows_within_limits_hold() -> None:
    assert all(verdicts([pair(1.4), pair(1.5), pair(9.0, steal=3)]).values())


def test_timing_rows_above_limits_fail() -> None:
    missed = {name for name, holds in verdicts([pair(2.1, late=5)] * 3, tick=300_000).items() if not holds}
    assert missed == {
        "all pairs, p99 over cyclictest's",
        "pairs without steal, p99.9 over cyclictest's",
        "late wake-ups, all pairs together",
        "tick, p99",
    }
    assert verdicts([pair(1.0)], tick=300_000, rate=4000.0)["tick, p99"]


def test_timing_rows_pairs_with_steal_excluded_from_p999() -> None:
    name = "pairs without steal, p99.9 over cyclictest's"
    assert not verdicts([pair(3.0), pair(3.0), pair(1.0, steal=1)])[name]
    assert verdicts([pair(1.0), pair(3.0, steal=1), pair(3.0, steal=2)])[name]


def test_median_interval_contains_median() -> None:
    median, low, high = median_interval(list(np.random.default_rng(1).lognormal(0.0, 0.5, 20)))
    assert low < median < high
    assert median_interval([1.25] * 20) == (1.25, 1.25, 1.25)
    assert np.isnan(median_interval([])).all()


def test_timing_table_shows_all_pairs() -> None:
    assert table([pair(1.0), pair(1.1)], 1000.0).row_count == 2
