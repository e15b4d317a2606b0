"""Clocks of the loop: the grid is absolute, missed ticks are skipped, no tick is early."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.clock import MAX_SPIN, FreeClock, GridClock, PacedClock, absolute_sleep

PERIOD = 1_000_000
START = 5_000_000_123
LOOK = 100
"""ns that a look at the clock takes."""


class World:
    """A machine whose time passes only during sleep, work or a reading of the clock."""

    def __init__(self, latency: int = 0) -> None:
        self.now, self.latency, self.sleeps, self.looks = START, latency, 0, 0

    def look(self) -> int:
        self.looks += 1
        self.now += LOOK
        return self.now

    def sleep_until(self, due: int) -> None:
        self.now = max(self.now, due) + self.latency
        self.sleeps += 1
        self.looks = 0

    def clock(self, period: int = PERIOD) -> GridClock:
        return GridClock(period, self.look, self.sleep_until)


@pytest.mark.parametrize("latency", [0, 7_000, MAX_SPIN - LOOK])
def test_grid_clock_usual_latency_keeps_ticks_on_grid(latency: int) -> None:
    world = World(latency)
    clock = world.clock()
    for k in range(1, 2000):
        time_s = clock.wait()
        world.now += 100_000
        assert clock.due == START + LOOK + k * PERIOD
        assert 0 <= clock.woke - clock.due < LOOK
        assert time_s == pytest.approx(clock.woke * 1e-9, abs=1e-9)
    assert clock.period == pytest.approx(1e-3)


@pytest.mark.parametrize("period", [200_000, 250_000, 500_000, PERIOD, 10 * PERIOD])
def test_grid_clock_spins_under_one_twentieth_of_period(period: int) -> None:
    world = World()
    clock = world.clock(period)
    for _ in range(10):
        clock.wait()
        assert world.sleeps
        assert 0 < world.looks * LOOK < 0.05 * period


@pytest.mark.parametrize(
    ("work", "skipped"),
    [
        (PERIOD - 1, 0),
        (PERIOD, 0),
        (PERIOD + 1, 1),
        (2 * PERIOD, 1),
        (2 * PERIOD + 1, 2),
        (100 * PERIOD + 5, 100),
    ],
)
def test_grid_clock_overrun_skips_missed_ticks(work: int, skipped: int) -> None:
    world = World()
    clock = world.clock()
    clock.wait()
    first = clock.due
    world.now = first + work - LOOK
    clock.wait()
    assert clock.due == first + (1 + skipped) * PERIOD
    clock.wait()
    assert clock.due == first + (2 + skipped) * PERIOD, "no burst follows"


@given(st.lists(st.tuples(st.integers(0, 10 * PERIOD), st.integers(0, 10 * PERIOD)), max_size=50))
def test_grid_clock_random_delays_keep_ticks_on_grid(delays: list[tuple[int, int]]) -> None:
    world = World()
    clock = world.clock()
    clock.wait()
    first, before = clock.due, clock.due
    for work, latency in delays:
        world.now += work
        asked, world.latency = world.now, latency
        clock.wait()
        assert clock.due >= asked, "the grid point lay ahead when the loop came to wait"
        assert clock.woke >= clock.due > before
        assert (clock.due - first) % PERIOD == 0
        before = clock.due


def test_grid_clock_early_sleep_return_sleeps_again() -> None:
    world = World()

    def interrupted(due: int) -> None:
        world.now += 300_000
        world.sleeps += 1

    clock = GridClock(PERIOD, world.look, interrupted)
    clock.wait()
    assert clock.woke >= clock.due
    assert world.sleeps == 4, "it sleeps again, it does not spin"


@pytest.fixture
def alarms() -> Iterator[list[int]]:
    """SIGALRM every 3 ms; the list grows with each."""
    seen: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, _: seen.append(number))
    signal.setitimer(signal.ITIMER_REAL, 0.003, 0.003)
    yield seen
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


def test_grid_clock_signals_make_no_tick_early(alarms: list[int]) -> None:
    clock = GridClock(10 * PERIOD)
    for _ in range(20):
        time_s = clock.wait()
        assert time.monotonic() >= time_s >= clock.due * 1e-9 - 1e-9
    assert len(alarms) >= 10, "the handlers ran"


def test_grid_clock_signal_handler_exception_leaves_wait(alarms: list[int]) -> None:
    def leave(*_: object) -> None:
        raise KeyboardInterrupt

    def wait_with_an_alarm() -> None:
        signal.signal(signal.SIGALRM, leave)
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        clock.wait()

    clock = GridClock(30_000 * PERIOD)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    with pytest.raises(KeyboardInterrupt):
        wait_with_an_alarm()


def test_grid_clock_times_follow_monotonic_clock() -> None:
    clock = GridClock(2 * PERIOD)
    before = time.monotonic()
    times = np.array([clock.wait() for _ in range(25)])
    after = time.monotonic()
    assert before < times[0]
    assert times[-1] < after
    assert np.all(np.diff(times) > 0.0)
    assert times[-1] - before >= 25 * 2e-3


def test_absolute_sleep_past_time_returns_at_once() -> None:
    sleep_until = absolute_sleep()
    before = time.monotonic_ns()
    sleep_until(before - 1_000_000_000)
    sleep_until(0)
    assert time.monotonic_ns() - before < 1_000_000_000


def test_absolute_sleep_negative_time_raises_os_error() -> None:
    with pytest.raises(OSError, match="Invalid argument"):
        absolute_sleep()(-1_000_000_000)


def test_free_clock_times_are_exact_multiples_of_period() -> None:
    clock = FreeClock(0.001)
    assert [clock.wait() for _ in range(5000)] == [k * 0.001 for k in range(5000)]


def test_paced_clock_late_tick_shifts_later_ones() -> None:
    wall, naps = [100.0], []

    def sleep(duration: float) -> None:
        naps.append(duration)
        wall[0] += duration

    clock = PacedClock(0.001, lambda: wall[0], sleep)
    times = []
    for k in range(6):
        times.append(clock.wait())
        wall[0] += 0.0005 if k != 2 else 0.0205
    assert times == [k * 0.001 for k in range(6)]
    assert naps == pytest.approx([0.0005] * 4)
