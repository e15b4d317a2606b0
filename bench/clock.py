"""Where a loop's ticks come from: time is tick times period, never a sum."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Gives the loop its ticks."""

    period: float
    """s"""

    def wait(self) -> float:
        """Wait for the next tick and return its time (s)."""


class FreeClock:
    """Virtual time, as fast as the machine allows: the same ticks have the same times, bit for bit."""

    def __init__(self, period: float) -> None:
        self.period = period
        self.tick = 0
        """Number of the next tick."""

    def wait(self) -> float:
        """Return the next tick's time (s) at once."""
        now = self.tick * self.period
        self.tick += 1
        return now


class PacedClock:
    """Virtual time at real speed: what the machine loses slips against the wall, and is counted."""

    def __init__(
        self,
        period: float,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._free = FreeClock(period)
        self._now, self._sleep = now, sleep
        self._start: float | None = None
        self.period = period
        self.slips = 0
        """Ticks that came more than a period late."""
        self.slipped = 0.0
        """Time lost against the wall, s."""

    def wait(self) -> float:
        """Sleep until the next tick is due and return its virtual time (s)."""
        virtual = self._free.wait()
        now = self._now()
        if self._start is None:
            self._start = now
        late = now - self._start - virtual
        if late < 0.0:
            self._sleep(-late)
        elif late > self.period:
            self._start += late
            self.slips += 1
            self.slipped += late
        return virtual
