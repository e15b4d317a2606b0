"""Clocks of a loop: time is tick times period, never a sum."""

from __future__ import annotations

import ctypes
import errno
import os
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Source of the loop's ticks."""

    period: float
    """Time between two ticks, s."""

    def wait(self) -> float:
        """Wait for the next tick and return its time (s)."""


class FreeClock:
    """Virtual time, as fast as the machine allows: the same ticks have the same times, bit for bit."""

    def __init__(self, period: float) -> None:
        self.period = period
        self.tick = 0
        """Number of the next tick."""

    def wait(self) -> float:
        """Return the next tick's time (s) without waiting."""
        now = self.tick * self.period
        self.tick += 1
        return now


class PacedClock:
    """Virtual time paced to the wall clock: it lags by delays of the computer."""

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
        self.due = self.woke = 0
        """Due time of the tick after all slips, and its start, ns of the wall's clock."""

    def wait(self) -> float:
        """Sleep until the next tick is due and return its virtual time (s)."""
        virtual = self._free.wait()
        now = self._now()
        if self._start is None:
            self._start = now
        late = now - self._start - virtual
        if late < 0.0:
            self._sleep(-late)
            now = self._now()
        elif late > self.period:
            self._start += late
        self.due, self.woke = round(1e9 * (self._start + virtual)), round(1e9 * now)
        return virtual


MAX_SPIN, SPIN_SHARE = 40_000, 0.04
"""Max time (ns) and share of the period for busy waiting at the end of a wait: it covers usual wake-up
latencies and takes two per cent of a core on average."""


class GridClock:
    """Wall time: ticks on an absolute grid of CLOCK_MONOTONIC.

    Sleeps until shortly before the grid point, then polls the clock. A grid point that has passed when the
    loop begins to wait is skipped, never caught up: after a stall the loop continues with the next point
    ahead.
    """

    def __init__(
        self,
        period_ns: int,
        now: Callable[[], int] = time.monotonic_ns,
        sleep_until: Callable[[int], None] | None = None,
    ) -> None:
        """The grid starts one period after the first `wait`; `sleep_until` may return early."""
        self.period_ns, self.period = period_ns, period_ns * 1e-9
        self._now, self._sleep_until = now, sleep_until or absolute_sleep()
        self._spin = min(MAX_SPIN, int(SPIN_SHARE * period_ns))
        self.due = 0
        """Grid point of the current tick, ns of CLOCK_MONOTONIC; 0 before the first."""
        self.woke = 0
        """Measured start of the current tick, ns."""

    def wait(self) -> float:
        """Wait for the next grid point ahead; return the measured time of the tick (s)."""
        now = self._now()
        due = (self.due or now) + self.period_ns
        if now > due:
            due += -(-(now - due) // self.period_ns) * self.period_ns
        self.due = due
        while (woke := self._now()) < due - self._spin:  # a signal may have ended the sleep
            self._sleep_until(due - self._spin)
        while woke < due:
            woke = self._now()
        self.woke = woke
        return woke * 1e-9


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def absolute_sleep() -> Callable[[int], None]:
    """Return `sleep_until(due)`: sleep until `due` (ns of CLOCK_MONOTONIC) or a signal.

    `time.sleep` takes a duration: whatever delays the thread between reading the clock and that call is
    added to it. `clock_nanosleep` with TIMER_ABSTIME takes the grid point itself.
    """
    library = ctypes.CDLL(None)
    nanosleep = library.clock_nanosleep
    nanosleep.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    request = _Timespec()
    address, clock, absolute = ctypes.addressof(request), time.CLOCK_MONOTONIC, 1

    def sleep_until(due: int) -> None:
        request.seconds, request.nanoseconds = divmod(due, 1_000_000_000)
        code = nanosleep(clock, absolute, address, None)
        if code not in (0, errno.EINTR):
            raise OSError(code, os.strerror(code))

    return sleep_until
