"""Ticks on the wall's clock: never early, at most some at once, every tick done or slipped."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.nodes.wall_plant import WallGrid

PERIOD = 1e-3


def take(grid: WallGrid, now: float) -> list[float]:
    """Return the instants of the ticks done at `now`."""
    done = []
    for _ in range(grid.take_due(now)):
        done.append(grid.instant)
        grid.line += 1
    return done


def test_wall_grid_yields_one_tick_per_period() -> None:
    grid = WallGrid(PERIOD, 17.2504, 5)
    assert take(grid, 17.2504) == []
    assert take(grid, 17.25102) == [pytest.approx(17.251)]
    assert take(grid, 17.2515) == []
    assert take(grid, 17.25295) == [pytest.approx(17.252)]
    assert (grid.slips, grid.slipped_ticks) == (0, 0)


def test_wall_grid_short_stall_catches_up_long_stall_slips() -> None:
    grid = WallGrid(PERIOD, 0.0, 5)
    assert len(take(grid, 0.0045)) == 5
    assert (grid.slips, grid.slipped_ticks) == (0, 0)
    assert take(grid, 0.0305) == pytest.approx([0.026, 0.027, 0.028, 0.029, 0.030])
    assert (grid.slips, grid.slipped_ticks) == (1, 21)
    assert take(grid, 0.0315) == [pytest.approx(0.031)]


@given(
    start=st.floats(0.0, 1e7),
    waits=st.lists(st.floats(0.0, 0.02), max_size=50),
    period=st.sampled_from([2e-4, 1e-3, 1 / 3000]),
    max_catch_up=st.integers(1, 20),
)
def test_wall_grid_loses_no_tick_and_runs_none_early(
    start: float, waits: list[float], period: float, max_catch_up: int
) -> None:
    grid = WallGrid(period, start, max_catch_up)
    first, now, done = grid.line, start, 0
    for wait in waits:
        now += wait
        instants = take(grid, now)
        done += len(instants)
        assert len(instants) <= max_catch_up
        assert all(instant <= now + 1e-8 for instant in instants)
        assert grid.instant > now - 1e-8  # nothing that is due is left
        assert done + grid.slipped_ticks == grid.line - first
