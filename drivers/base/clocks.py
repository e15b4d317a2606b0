"""Offset of the wall clock, in which buses stamp frames, to CLOCK_MONOTONIC."""

from __future__ import annotations

import time

MAX_READ = 2_000
"""Max duration of a reading of both clocks, ns: a longer one was interrupted."""


class WallOffset:
    """The offset as last read without an interruption."""

    def __init__(self) -> None:
        """Read it."""
        self.ns = time.time_ns() - time.monotonic_ns()
        """Lead of the wall clock (ns)."""

    def read(self) -> int:
        """Return the offset now, ns; the last one where the thread was interrupted between the clocks."""
        before, now, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < MAX_READ:
            self.ns = now - (before + after) // 2
        return self.ns
