"""Ctrl-C, SIGTERM and a closed terminal as a flag that the work polls, no exception in a tick; the exit."""

from __future__ import annotations

import os
import signal
import stat
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import NoReturn

CLOSING_THREAD = "golfbench closing"
"""Name of threads that `leave` does not wait for."""
HANGUP = tuple(number for number in signal.Signals if number.name == "SIGHUP")
"""Signal of a closed terminal or a lost remote login; empty on systems without it."""

_ENDING = (signal.SIGTERM, *HANGUP)


class Terminated(BaseException):
    """SIGTERM or a closed terminal ended a block whose work is complete."""


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
        if number in HANGUP:
            _abandon_terminal()

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

    With `terminate` SIGTERM and a closed terminal also set it; the block then ends with Terminated. Child
    processes of the block that are ended by SIGTERM must not inherit this.

    Inside the block the robot is brought to rest and files are written whole; `golfbench` then ends with
    exit code 130, after SIGTERM 143. Outside the main thread, which gets no signals, the flag is never set.
    """
    asked = StopFlag()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    with _handled(asked, (signal.SIGINT, *_ENDING) if terminate else (signal.SIGINT,)):
        yield asked
    if asked.is_made():
        raise KeyboardInterrupt if asked.cause == "Ctrl-C" else Terminated


@contextmanager
def stop_on_signals() -> Iterator[StopFlag]:
    """Yield a flag that SIGTERM, Ctrl-C and a closed terminal set."""
    flag = StopFlag()
    with _handled(flag, (signal.SIGINT, *_ENDING)):
        yield flag


@contextmanager
def _handled(flag: StopFlag, numbers: Iterable[int]) -> Iterator[None]:
    """Let signals `numbers` set `flag` inside the block; a hangup that nohup ignores stays ignored."""
    before = {
        number: signal.signal(number, flag.make)
        for number in numbers
        if not (number in HANGUP and signal.getsignal(number) is signal.SIG_IGN)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _abandon_terminal() -> None:
    """Discard later output to the terminal: each write to a closed one would raise."""
    with suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for descriptor in (1, 2):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode):
                os.dup2(nowhere, descriptor)
        os.close(nowhere)


def leave(code: int) -> NoReturn:
    """Exit with `code`, at once while a CLOSING_THREAD waits for a peer that does not read."""
    if any(thread.name == CLOSING_THREAD for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
