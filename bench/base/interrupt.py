"""Ctrl-C and SIGTERM as a flag that the work polls, not an exception in the middle of a tick; the exit."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

CLOSING_THREAD = "golfbench closing"
"""Name of threads that `leave` does not wait for."""


class Terminated(BaseException):
    """SIGTERM ended a block whose work is complete."""


class StopFlag:
    """Request to stop, set in a signal handler.

    Not a threading.Event: its `set` takes a lock that the interrupted `wait` of the same thread may hold, and
    then the process never ends.
    """

    def __init__(self) -> None:
        self._made = False
        self.cause = "Ctrl-C"
        """Name of the signal that set the flag first."""

    def make(self, number: int = signal.SIGINT, *_: object) -> None:
        """Set the flag; as a signal handler, for signal `number`."""
        if not self._made and number != signal.SIGINT:
            self.cause = signal.Signals(number).name
        self._made = True

    def is_made(self) -> bool:
        """Return whether a stop was requested."""
        return self._made

    def wait(self, duration: float) -> bool:
        """Sleep for `duration` (s), even if the flag is set meanwhile; return whether it is set."""
        if not self._made:
            time.sleep(duration)
        return self._made


@contextmanager
def deferred_interrupt(*, terminate: bool = False) -> Iterator[StopFlag]:
    """Yield a flag that Ctrl-C sets; raise KeyboardInterrupt at the end of the block if it was set.

    With `terminate` SIGTERM sets it, too; the block then ends with Terminated. Child processes of the block
    that are ended by SIGTERM must not inherit this.

    Inside the block the robot is brought to rest and files are written whole; `golfbench` then ends with
    exit code 130, after SIGTERM 143. Outside the main thread, which gets no signals, the flag is never set.
    """
    asked = StopFlag()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    numbers = (signal.SIGINT, signal.SIGTERM) if terminate else (signal.SIGINT,)
    before = {number: signal.signal(number, asked.make) for number in numbers}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if asked.is_made():
        if asked.cause == "SIGTERM":
            raise Terminated
        raise KeyboardInterrupt


@contextmanager
def stop_on_signals() -> Iterator[StopFlag]:
    """Yield a flag that SIGTERM and Ctrl-C set."""
    flag = StopFlag()
    kept = {number: signal.signal(number, flag.make) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield flag
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)


def leave(code: int) -> NoReturn:
    """Exit with `code`, at once while a CLOSING_THREAD waits for a peer that does not read."""
    if any(thread.name == CLOSING_THREAD for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
