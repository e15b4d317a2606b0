"""The live view's time axis: seconds since the first cycle shown, also when the loop's clock starts anew."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.viewer.signals import Array, Cycles

_BEHIND = 0.001
"""s between the last cycle of one loop and the first of the next, when the calendars do not say more."""
_HOLE = 0.010
"""s without a cycle that are drawn as a hole."""


class Placed(NamedTuple):
    """A batch's place on the time axis."""

    time: Array
    """s, one for each cycle."""
    hole: bool
    """Cycles are missing before it, or another loop begins."""


class ViewClock:
    """Maps cycles to the time axis: exact steps within one run of the loop, the calendar's between two."""

    def __init__(self) -> None:
        self._shift = 0.0
        self._utc_zero: float | None = None
        self._tick, self._time = 0, 0.0

    def place(self, cycles: Cycles, utc: float) -> Placed:
        """Return where `cycles` lie, whose newest is of `utc` (s since 1970)."""
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
        """Return the place of an instant on the loop's clock (s)."""
        return loop_time + self._shift

    @property
    def now(self) -> float:
        """The newest cycle's place, s."""
        return self._time

    def utc(self, time: Array) -> Array:
        """Return the calendar's seconds since 1970 of places on the time axis."""
        return np.asarray(time, dtype=float) + (self._utc_zero or 0.0)
