"""Histograms of the loop's ticks agree with numpy's percentiles, in constant memory, across processes."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from bench.base.errors import ExitCode, Refused
from bench.supervisor._tick_timing import TickTiming, check_budget, create_timing, new_timing
from bench.supervisor._timing_record import (
    BUCKETS,
    LATE,
    SEGMENTS,
    STAMPS,
    TIMING,
    Stall,
    TimingReader,
    percentile,
    summary,
    upper_edges,
)
from drivers.base.shared_memory import SharedMemoryError

PERIOD = 1_000_000
SHARES = {"p50_us": 0.5, "p99_us": 0.99, "p999_us": 0.999, "max_us": 1.0}
EXACT_FROM, EXACT_TO = 256, 2**27 - 1

durations = st.one_of(
    st.integers(0, 2**31), st.integers(0, 5000), st.floats(0.0, 31.0).map(lambda power: int(2**power))
)


def stamps_of(segments: list[int], begin: int) -> NDArray[np.int64]:
    return begin + np.cumsum([0, *segments])


def timing_of(ticks: NDArray[np.int64], record: np.ndarray | None = None) -> np.ndarray:
    """Return the record of `ticks` (n, 8): latency, orders and the six segments of each, ns."""
    record = new_timing(PERIOD) if record is None else record
    timing = TickTiming(record)
    for k, (latency, orders, *segments) in enumerate(ticks.tolist()):
        due = (k + 1) * PERIOD
        timing.note(stamps_of(segments, due + latency + orders), due, due + latency)
    return record


def random_ticks(n: int, seed: int = 0) -> NDArray[np.int64]:
    """Return n ticks as `timing_of` takes them: mostly short, some very long."""
    return np.random.default_rng(seed).lognormal(10.0, 2.0, (n, 8)).astype(np.int64)


def test_upper_edges_are_fine() -> None:
    edges = upper_edges()
    assert len(edges) == BUCKETS
    inner = edges[:-1].astype(float)
    assert (inner[0], inner[-1]) == (256, 2**27)
    assert np.all(np.diff(inner) / inner[:-1] <= 1 / 16)


@given(st.lists(durations | st.sampled_from([-5, 255, 256, 2**27 - 1, 2**27, 2**62]), max_size=20))
def test_tick_timing_counts_latencies_between_edges(latencies: list[int]) -> None:
    record = new_timing(PERIOD)
    timing = TickTiming(record)
    for latency in latencies:
        timing.note(stamps_of([0] * 6, latency), 0, latency)
    edges = [np.iinfo(np.int64).min, *upper_edges()]
    counted, _ = np.histogram(latencies, edges)
    assert record["count"][0, 0].tolist() == counted.tolist()


@given(st.lists(durations, min_size=1, max_size=200), st.sampled_from([0.01, 0.5, 0.9, 0.99, 0.999, 1.0]))
def test_percentile_agrees_with_numpy(values: list[int], share: float) -> None:
    count = np.zeros(BUCKETS, np.int64)
    np.add.at(count, np.searchsorted(upper_edges(), values, side="right"), 1)
    exact = int(np.quantile(values, share, method="inverted_cdf"))
    found = percentile(count, share)
    assert exact <= found
    if EXACT_FROM <= exact <= EXACT_TO:
        assert found <= exact * (1 + 1 / 16) + 1
    else:
        assert found in (256, np.iinfo(np.int64).max)


def test_percentile_without_durations_raises() -> None:
    with pytest.raises(ValueError, match="no durations"):
        percentile(np.zeros(BUCKETS, np.int64), 0.5)


def test_summary_each_segment_matches_numpy_percentiles() -> None:
    ticks = random_ticks(3000)
    found = summary(timing_of(ticks))
    columns = dict(zip(SEGMENTS[:-1], ticks.T, strict=True)) | {"tick": ticks[:, 1:].sum(axis=1)}
    assert found["ticks"] == 3000
    assert found["late"] == np.count_nonzero(ticks[:, 0] > LATE) > 0
    assert tuple(found["segments"]) == SEGMENTS
    for name, values in columns.items():
        figures = found["segments"][name]
        assert figures["count"] == 3000
        assert figures["max_us"] == values.max() / 1000, "the longest is exact"
        for key, share in SHARES.items():
            exact = float(np.quantile(values, share, method="inverted_cdf")) / 1000
            assert exact <= figures[key] <= exact * (1 + 1 / 16) + 0.256, (name, key)


def test_summary_two_snapshots_counts_difference() -> None:
    first, second = random_ticks(500, seed=1), random_ticks(400, seed=2) // 8
    record = timing_of(first)
    before = record.copy()
    timing_of(second, record)
    found = summary(record, before)
    assert found["ticks"] == 400
    latency = found["segments"]["wake_up"]
    assert latency["count"] == 400
    for key, share in SHARES.items():
        exact = float(np.quantile(second[:, 0], share, method="inverted_cdf")) / 1000
        assert exact <= latency[key] <= exact * (1 + 1 / 16) + 0.256


def test_tick_timing_stall_returns_delay_and_counts_kind() -> None:
    record = new_timing(PERIOD)
    timing = TickTiming(record)
    assert timing.note(stamps_of([0] * 6, PERIOD), PERIOD, PERIOD + 5) == 0
    late = LATE + 7
    assert timing.note(stamps_of([0] * 6, 2 * PERIOD), 2 * PERIOD, 2 * PERIOD + late) == late
    assert timing.note(stamps_of([0] * 6, 5 * PERIOD), 5 * PERIOD, 5 * PERIOD) == 2 * PERIOD
    timing.note_stall(Stall.MACHINE)
    timing.note_stall(Stall.PREEMPTION)
    timing.note_stall(Stall.MACHINE)
    timing.note_usage(4, 9)
    found = summary(record)
    assert found["stalls"] == {"preemption": 1, "page_fault": 0, "long_tick": 0, "machine": 2}
    assert (found["page_faults"], found["preemptions"]) == (4, 9)
    timing.close()
    timing.note_usage(1, 1)  # after its end it counts into nothing
    assert record["page_faults"][0] == 4


def test_summary_without_ticks_has_no_figures() -> None:
    record = new_timing(PERIOD)
    found = json.loads(json.dumps(summary(record, record.copy()), allow_nan=False))
    assert (found["ticks"], found["skipped"], found["late"], found["period_us"]) == (0, 0, 0, 1000.0)
    assert found["segments"]["tick"] == {"count": 0} | dict.fromkeys(SHARES)


@given(st.lists(st.integers(0, 20), max_size=30))
def test_tick_timing_skipped_grid_points_are_counted(gaps: list[int]) -> None:
    record = new_timing(PERIOD)
    timing, due = TickTiming(record), 7 * PERIOD
    for gap in (0, *gaps):
        due += (1 + gap) * PERIOD
        timing.note(stamps_of([0] * 6, due), due, due)
    assert record["skipped"][0] == sum(gaps)
    assert record["due"][0] == due


def test_tick_timing_late_counts_above_bound_only() -> None:
    record = new_timing(PERIOD)
    timing = TickTiming(record)
    for latency, late in ((LATE, 0), (LATE + 1, 1)):
        timing.note(stamps_of([0] * 6, PERIOD + latency), PERIOD, PERIOD + latency)
        assert record["late"][0] == late


@pytest.mark.live
def test_tick_timing_without_jit_counts_equally() -> None:
    program = (
        "import numpy as np, sys; sys.path.insert(0, 'tests/bench/supervisor')\n"
        "from test_tick_timing import *\n"
        "print(timing_of(random_ticks(50)).tobytes().hex())"
    )
    root = Path(__file__).parents[3]
    answer = subprocess.run(
        [sys.executable, "-c", program],
        env={"NUMBA_DISABLE_JIT": "1", "PATH": "", "PYTHONPATH": str(root)},
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    assert answer.stdout.strip() == timing_of(random_ticks(50)).tobytes().hex()


# The file --------------------------------------------------------------------------------------------


def test_timing_reader_snapshot_is_constant_and_read_only(tmp_path: Path) -> None:
    path = tmp_path / "timing"
    with closing(create_timing(path, PERIOD)) as timing:
        reader = TimingReader(path)
        snapshot = reader.snapshot()
        timing.note(stamps_of([5] * 6, PERIOD), PERIOD, PERIOD)
        assert (snapshot["ticks"][0], reader.snapshot()["ticks"][0]) == (0, 1)
        assert path.stat().st_mode & 0o777 == 0o600
        with pytest.raises(ValueError, match="read-only"):
            snapshot["ticks"] = 1
        timing.close()  # allowed twice


@pytest.mark.parametrize("content", [b"", b"x" * 100, bytes(TIMING.itemsize), b"\xff" * TIMING.itemsize])
def test_timing_reader_foreign_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "timing"
    path.write_bytes(content)
    with pytest.raises(SharedMemoryError, match=r"timing: found .* expected the loop's timing"):
        TimingReader(path)


def test_timing_file_missing_or_existing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SharedMemoryError, match="No such file"):
        TimingReader(tmp_path / "timing")
    with pytest.raises(SharedMemoryError, match="No such file"):
        create_timing(tmp_path / "nowhere" / "timing", PERIOD)
    with (
        closing(create_timing(tmp_path / "timing", PERIOD)),
        pytest.raises(SharedMemoryError, match="File exists"),
    ):
        create_timing(tmp_path / "timing", PERIOD)


# The budget ------------------------------------------------------------------------------------------


def stamps(n: int = 200, **segments: int) -> NDArray[np.int64]:
    """Return stamps of n ticks whose segments take 1 us, but those named."""
    cost = [segments.get(name, 1000) for name in STAMPS[1:]]
    ticks: NDArray[np.int64] = np.arange(n)[:, None] * PERIOD + np.cumsum([0, *cost])
    return ticks


def test_check_budget_short_ticks_pass() -> None:
    check_budget(stamps(decide=795_000), PERIOD)


@pytest.mark.parametrize(
    ("segment", "action"),
    [("read", "driver's read"), ("decide", "NUMBA_DISABLE_JIT"), ("publish", "in memory")],
)
def test_check_budget_long_tick_names_longest_segment(segment: str, action: str) -> None:
    with pytest.raises(Refused) as refused:
        check_budget(stamps(**{segment: 796_000}), PERIOD)
    text = str(refused.value)
    assert refused.value.exit_code == ExitCode.REFUSED
    assert "1000 Hz, with ticks of 801 µs" in text
    assert f"{segment!r} is longest, 796 µs" in text
    assert action in text
    assert "at most 998 Hz" in text


def test_check_budget_suggested_rate_passes() -> None:
    ticks = stamps(write=3_000_000)
    with pytest.raises(Refused, match="266 Hz"):
        check_budget(ticks, PERIOD)
    check_budget(ticks, int(1e9 / 266))


def test_check_budget_rare_stalls_pass_and_frequent_are_refused() -> None:
    ticks = stamps(n=200)
    ticks[::11, -1] += 8_000_000
    check_budget(ticks, PERIOD)
    ticks[::9, -1] += 8_000_000
    with pytest.raises(Refused):
        check_budget(ticks, PERIOD)


def test_check_budget_without_ticks_raises() -> None:
    with pytest.raises(ValueError, match="no ticks"):
        check_budget(np.zeros((0, 7), np.int64), PERIOD)
