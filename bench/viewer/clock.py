"""Time axis of the live view: seconds since the first cycle shown, continuous over loop restarts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.viewer.signals import Array, Cycles

_BEHIND = 0.001
"""Min time between the last cycle of one loop and the first of the next, s."""
_HOLE = 0.010
"""Time without a cycle that is drawn as a gap, s."""


class Placed(NamedTuple):
    """A batch's place on the time axis."""

    time: Array
    """Time of each cycle, s."""
    hole: bool
    """Whether cycles are missing before it, or another loop starts."""


class ViewClock:
    """Maps cycles to the time axis: by loop time within one run of the loop, by UTC between runs."""

    def __init__(self) -> None:
        self._shift = 0.0
        self._utc_zero: float | None = None
        self._tick, self._time = 0, 0.0

    def place(self, cycles: Cycles, utc: float) -> Placed:
        """Return the times of `cycles`, whose newest is at `utc` (s since 1970)."""
        first, last = float(cycles["time"][0]), float(cycles["time"][-1])
        tick = int(cycles["tick"][0])
        if self._utc_zero is None:
            self._utc_zero, self._shift = utc - (last - first), -first
            hole = False
        elif tick <= self._tick or first + self._shift <= self._time:
            by_calendar = utc - (last - first) - self._utc_zero
            self._shift = max(by_calendar, self._time + _BEHIND) - first
            hole = True
        else:
            hole = first + self._shift - self._time > _HOLE
        time = cycles["time"] + self._shift
        self._tick, self._time = int(cycles["tick"][-1]), float(time[-1])
        return Placed(time, hole)

    def of_loop(self, loop_time: float) -> float:
        """Return the time of an instant in loop time (s)."""
        return loop_time + self._shift

    @property
    def now(self) -> float:
        """Time of the newest cycle, s."""
        return self._time

    def utc(self, time: Array) -> Array:
        """Return UTC (s since 1970) of times on the time axis."""
        return np.asarray(time, dtype=float) + (self._utc_zero or 0.0)
