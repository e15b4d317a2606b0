"""Ticks in wall-clock time: a limited number of late ticks is caught up, the rest is skipped."""

from __future__ import annotations

from math import ceil, floor


class WallGrid:
    """The multiples of `period` (s) on a clock that is given, from the first one not before `now` on.

    Nothing is ever due before its instant.
    """

    def __init__(self, period: float, now: float, max_catch_up: int) -> None:
        self.period, self.max_catch_up = period, max_catch_up
        self.line = ceil(now / period)
        """Number of the next tick; due at this multiple of the period."""
        self.slips = 0
        self.slipped_ticks = 0

    @property
    def instant(self) -> float:
        """Time at which the next tick is due, s."""
        return self.line * self.period

    def take_due(self, now: float) -> int:
        """Return how many ticks are due at `now` (s), 0 … burst, after skipping those too late.

        The caller executes them and adds one to `line` for each.
        """
        due = floor(now / self.period) - self.line + 1
        if due > self.max_catch_up:
            self.slips += 1
            self.slipped_ticks += due - self.max_catch_up
            self.line += due - self.max_catch_up
            return self.max_catch_up
        return max(due, 0)
