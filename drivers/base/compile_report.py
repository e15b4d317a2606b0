"""Reports of a compilation while it lasts; none where the machine code is in the cache."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

_FIRST, _BETWEEN = 1.0, 2.5
"""Time before the first report, and between two (s)."""


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


_report: Callable[[str], object] = _print


def announce_compilation(report: Callable[[str], object]) -> None:
    """Call `report` with each line on this process' compilations; without it they go to standard error."""
    global _report  # noqa: PLW0603 - a process has one compiler
    _report = report


def report_compilation(text: str) -> None:
    """Report a line of another process, for which this one waits."""
    _report(text)


class CompileProgress:
    """Counts functions that are compiled, and reports their number."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.known = 0
        """Number of functions that may be compiled."""
        self.compiled: set[int] = set()
        """Identities of those that were compiled, for some of them several times."""
        self._begin = self._due = 0.0

    def note(self, done: object = None) -> None:
        """Record the start of a compilation, or the end of that of the function `done`."""
        now = self._clock()
        if not self._begin:
            self._begin, self._due = now, now + _FIRST
        if done is not None:
            self.compiled.add(id(done))
        if now >= self._due:
            self._due = now + _BETWEEN
            report_compilation(
                f"compiling, once for each version: {len(self.compiled)} of at most "
                f"{max(self.known, len(self.compiled))} functions, {now - self._begin:.0f} s"
            )


progress = CompileProgress()
"""The compilations of this process."""
