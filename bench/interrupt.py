"""Ctrl-C and SIGTERM as a wish that the work asks for, instead of an exception in the middle of a tick."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager


class StopFlag:
    """A wish to end, made in a signal's handler.

    Not a threading.Event: its `set` takes a lock that the interrupted `wait` of the same thread may hold, and
    then the process never ends.
    """

    def __init__(self) -> None:
        self._made = False

    def make(self, *_: object) -> None:
        """Make it; what a signal calls its handler with is not looked at."""
        self._made = True

    def is_made(self) -> bool:
        """Tell whether somebody wishes the end."""
        return self._made

    def wait(self, duration: float) -> bool:
        """Sleep for `duration` (s), also when the wish comes meanwhile; tell whether it is made."""
        if not self._made:
            time.sleep(duration)
        return self._made


@contextmanager
def deferred_interrupt() -> Iterator[StopFlag]:
    """Yield a wish that Ctrl-C makes; at the block's end a Ctrl-C that came raises KeyboardInterrupt.

    Inside the block the robot is brought to rest and files are written whole; `golfbench` then ends with
    exit code 130. Outside the main thread, which gets no signals, the wish is never made.
    """
    asked = StopFlag()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    before = signal.signal(signal.SIGINT, asked.make)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)
    if asked.is_made():
        raise KeyboardInterrupt


@contextmanager
def stop_on_signals() -> Iterator[StopFlag]:
    """Yield a wish that SIGTERM and Ctrl-C make."""
    wish = StopFlag()
    kept = {number: signal.signal(number, wish.make) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield wish
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
