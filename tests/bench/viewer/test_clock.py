from __future__ import annotations

import numpy as np
import pytest

from bench.telemetry.cycle_record import CYCLE
from bench.viewer.viewer import ViewClock


def cycles(first_tick: int, count: int, start: float) -> np.ndarray:
    made = np.zeros(count, CYCLE)
    made["tick"] = first_tick + np.arange(count)
    made["time"] = start + np.arange(count) / 1024
    return made


def test_it_begins_at_zero_and_keeps_exact_steps() -> None:
    clock = ViewClock()
    first = clock.place(cycles(500, 20, 1000.0), 5000.0)
    assert not first.hole
    assert np.array_equal(first.time, np.arange(20) / 1024)
    following = clock.place(cycles(520, 20, 1000.0 + 20 / 1024), 5123.0)  # the calendar does not matter
    assert not following.hole
    assert np.array_equal(following.time, np.arange(20, 40) / 1024)
    assert clock.now == 39 / 1024
    assert clock.of_loop(1001.0) == 1.0


def test_the_calendar_of_a_place_is_that_of_its_tick() -> None:
    clock = ViewClock()
    placed = clock.place(cycles(1, 11, 7.0), 5000.0)
    assert clock.utc(placed.time)[-1] == pytest.approx(5000.0)
    assert clock.utc(placed.time)[0] == pytest.approx(5000.0 - 10 / 1024)


def test_missing_cycles_are_a_hole_of_their_length() -> None:
    clock = ViewClock()
    clock.place(cycles(1, 20, 0.0), 5000.0)
    later = clock.place(cycles(1025, 20, 1.0), 5001.0)
    assert later.hole
    assert later.time[0] == 1.0


def test_another_loop_goes_on_after_the_calendars_gap() -> None:
    clock = ViewClock()
    clock.place(cycles(9000, 20, 300.0), 5000.0)
    anew = clock.place(cycles(1, 20, 0.0), 5008.0)
    assert anew.hole
    assert anew.time[-1] == pytest.approx(8.0 + 19 / 1024)
    assert np.allclose(np.diff(anew.time), 1 / 1024)


def test_time_never_runs_backwards_whatever_the_calendar_says() -> None:
    clock = ViewClock()
    end = clock.place(cycles(9000, 20, 300.0), 5000.0).time[-1]
    anew = clock.place(cycles(1, 20, 0.0), 4000.0)
    assert anew.time[0] > end
