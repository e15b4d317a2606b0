"""Waiting for another thread or process, as long as anything may take on a busy machine."""

from __future__ import annotations

import time
from collections.abc import Callable

HURRY = 15.0
"""s that anything may take on a busy machine."""


def wait_until(
    holds: Callable[[], object],
    longest: float = 60.0,
    words: Callable[[], object] = str,
    nudge: Callable[[], object] = str,
) -> None:
    """Return once `holds` does, with a `nudge` after each vain look; fail after `longest` s with `words`."""
    deadline = time.monotonic() + longest
    while not holds():
        assert time.monotonic() < deadline, words()
        nudge()
        time.sleep(0.005)
