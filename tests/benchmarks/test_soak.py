"""Criteria of a soak: growth per hour, and a settable clock."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.process_samples import ProcessFigures, figures_of, growth, growths, stolen_time
from tests.benchmarks.soak import Sample, leaks
from tests.benchmarks.wall_clock import WallClock

TIMES = np.arange(0.0, 4 * 3600.0, 60.0)
DRAWN = np.random.default_rng(7)


def test_growth_estimates_hourly_slope_of_second_half() -> None:
    settling = np.where(TIMES < 3600.0, 40.0 * TIMES / 3600.0, 40.0)
    leaking = settling + 3.0 * TIMES / 3600.0 + DRAWN.normal(0.0, 0.5, len(TIMES))
    found = growth(TIMES, leaking)
    assert found.low < 3.0 < found.high
    assert found.high - found.low < 0.5
    still = growth(TIMES, settling + DRAWN.normal(0.0, 0.5, len(TIMES)))
    assert still.low < 0.0 < still.high


def test_growth_few_samples_is_nan() -> None:
    assert np.isnan(growth([0.0, 60.0, 120.0], [1.0, 2.0, 3.0]).slope)


def test_leaks_names_only_growing_process() -> None:
    samples = [
        Sample(
            at,
            {
                "loop": ProcessFigures(100.0, 50.0, 16, 1),
                "page": ProcessFigures(100.0, 50.0 + 2.0 * at / 3600.0, 20 + at // 1800, 8),
            },
            {},
        )
        for at in TIMES
    ]
    memory, descriptors, threads = leaks("soak", samples)
    assert (memory.value, descriptors.value, threads.value) == (1, 1, 0)
    assert "page" in memory.note
    assert not memory.holds
    assert growths(TIMES.tolist(), [one.processes for one in samples], "unique")["loop"].slope == 0.0


def test_figures_of_own_process_are_plausible() -> None:
    found = figures_of(os.getpid())
    assert found is not None
    assert found.resident >= found.unique > 1.0
    assert found.descriptors >= 3
    assert found.threads >= 1
    assert figures_of(2**22 + 1) is None
    assert stolen_time() >= 0.0


_ASK = """
import datetime, sys, time
for line in sys.stdin:
    print(time.time(), datetime.datetime.now(datetime.UTC).timestamp(), time.monotonic(), flush=True)
"""


@pytest.mark.requires("cc")
def test_wall_clock_set_leaves_monotonic_clock(tmp_path: Path) -> None:
    clock = WallClock(tmp_path)
    with subprocess.Popen(
        [sys.executable, "-c", _ASK],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **clock.environment},
    ) as process:
        assert process.stdin
        assert process.stdout
        found = []
        for ahead in (0.0, 86400.0, -3600.0):
            clock.set(ahead)
            print(file=process.stdin, flush=True)
            found.append([float(word) for word in process.stdout.readline().split()])
            assert abs(found[-1][0] - clock.now()) < 30.0
            assert abs(found[-1][1] - clock.now()) < 30.0
        assert 0.0 < found[2][2] - found[0][2] < 60.0
        process.stdin.close()
