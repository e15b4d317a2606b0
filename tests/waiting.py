"""Waiting for another thread or process, as long as anything may take on a busy machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

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


def wait_until_stopped(pid: int) -> None:
    """Return once process `pid` stands still by SIGSTOP."""
    deadline = time.monotonic() + 10
    while Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "T":
        assert time.monotonic() < deadline
        time.sleep(0.0002)
