"""Ctrl-C, SIGTERM, closed terminal or pipe as a flag that the work polls, without exceptions; the exit."""

from __future__ import annotations

import os
import signal
import stat
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedWriter, FileIO, TextIOWrapper
from typing import Any, NoReturn

CLOSING_THREAD = "golfbench closing"
"""Name of threads that `leave` does not wait for."""
HANGUP = tuple(number for number in signal.Signals if number.name == "SIGHUP")
"""Signal of a closed terminal or a lost remote login; empty on systems without it."""

_ENDING = (signal.SIGTERM, *HANGUP)


class Terminated(BaseException):
    """SIGTERM, a closed terminal or pipe ended a block whose work is complete."""


class StopFlag:
    """Request to stop, set in a signal handler.

    Not a threading.Event: its `set` takes a lock that the interrupted `wait` of the same thread may hold, and
    then the process never ends.
    """

    def __init__(self) -> None:
        self._made = False
        self.cause = "Ctrl-C"
        """Name of the signal that set the flag first, or "a closed pipe"."""

    def make(self, number: int = signal.SIGINT, *_: object) -> None:
        """Set the flag; as a signal handler, for signal `number`."""
        self._make("Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name)
        if number in HANGUP:
            _abandon_terminal()

    def make_by_pipe(self) -> None:
        """Set the flag as the reader of the output has ended."""
        self._make("a closed pipe")

    def _make(self, cause: str) -> None:
        if not self._made:
            self.cause = cause
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

    With `terminate` SIGTERM, a closed terminal and an output of `watch_pipes` without reader also set it; the
    block then ends with Terminated. Child processes of the block that are ended by SIGTERM must not inherit
    this.

    Inside the block the robot is brought to rest and files are written whole; `golfbench` then ends with
    exit code 130, after SIGTERM 143. Outside the main thread, which gets no signals, the flag is never set.
    """
    asked = StopFlag()
    outer = getattr(signal.getsignal(signal.SIGINT), "__self__", None)
    if isinstance(outer, StopFlag) and not terminate:
        yield outer  # the block around this one ends
        return
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    with _handled(asked, (signal.SIGINT, *_ENDING) if terminate else (signal.SIGINT,)):
        _Pipe.flag = asked if terminate else None
        try:
            yield asked
        finally:
            _Pipe.flag = None
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


class _Pipe(FileIO):
    """Standard output or errors into a pipe; once its reader has ended, later output is discarded."""

    is_closed = False
    """Whether the reader of one of them has ended."""
    flag: StopFlag | None = None
    """Flag that is set then in place of an error."""

    def write(self, data: Any) -> int:
        """Write `data`; return the number of bytes written."""
        try:
            return super().write(data)
        except BrokenPipeError:
            _Pipe.is_closed = True
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self.fileno())
            if _Pipe.flag is None:
                raise
            _Pipe.flag.make_by_pipe()
            return memoryview(data).nbytes


def watch_pipes() -> None:
    """Replace standard output and errors that are pipes by ones that notice the end of their reader."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if type(stream) is not TextIOWrapper or not stat.S_ISFIFO(os.fstat(stream.fileno()).st_mode):
            continue
        stream.flush()
        pipe = BufferedWriter(_Pipe(stream.fileno(), "wb", closefd=False))
        by_line = stream.line_buffering or stream.write_through
        text = TextIOWrapper(pipe, stream.encoding, stream.errors, line_buffering=by_line)
        setattr(sys, name, text)


def has_closed_pipe() -> bool:
    """Return whether output was lost as its reader has ended."""
    return _Pipe.is_closed


def leave(code: int) -> NoReturn:
    """Exit with `code`, at once while a CLOSING_THREAD waits for a peer that does not read."""
    if any(thread.name == CLOSING_THREAD for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
