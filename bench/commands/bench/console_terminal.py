"""The terminal while a command of the console runs: the stop key works, the last line shows the state.

A thread reads the keys and passes them on to the command through a pseudo-terminal. Questions, the key that
marks a shot, and Ctrl-C work as outside the console. Keys that the command does not read are dropped: a line
typed ahead never moves the robot.
"""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import sys
import termios
from collections.abc import Callable
from contextlib import suppress
from threading import Thread
from typing import Any, Self

_STOP = re.compile(rb"\x1b?\[19(;\d+)?~|\x1c")
"""Bytes of the stop keys: F8, also with Shift, Alt or Ctrl, and after a late Esc; Ctrl-\\."""
_UNFINISHED = re.compile(rb"\x1b(\[(1(9(;\d*)?)?)?)?$")
"""Start of F8 at the end of the keys."""
_ECHO_TIMEOUT = 0.02
"""Max time until the echo of a key arrives (s)."""
_MIN_ROWS = 5
"""Height of a terminal from which its last line shows the state."""


def count_stops(keys: bytes) -> tuple[int, bytes, bytes]:
    """Return how often `keys` have a stop key, the other keys, and those that may become one."""
    rest, number = _STOP.subn(b"", keys)
    unfinished = _UNFINISHED.search(rest)
    at = unfinished.start() if unfinished else len(rest)
    return number, rest[:at], rest[at:]


class CommandTerminal:
    """Stands between terminal and command for a `with`."""

    def __init__(self, on_stop: Callable[[], None], line: Callable[[int], str], period: float) -> None:
        """`on_stop` is called at each stop key; `line` returns the last line, drawn every `period` s."""
        self._on_stop, self._line, self._period = on_stop, line, period
        self._input = sys.stdin.fileno()
        self._pending = b""
        self._ended_lines = 0
        """Line ends shown here whose echo is still to come."""

    def __enter__(self) -> Self:
        self._terminal = os.dup(self._input)
        self._before = termios.tcgetattr(self._terminal)
        self._master, slave = pty.openpty()
        termios.tcsetattr(slave, termios.TCSANOW, self._before)
        os.set_blocking(self._master, False)
        os.dup2(slave, self._input)
        os.close(slave)
        self._woken, self._wake = os.pipe()
        termios.tcsetattr(self._terminal, termios.TCSANOW, _single_keys(self._before))
        self._write(b"\n\x1b[A")  # the last line may be the cursor's
        self._draw()
        self._thread = Thread(target=self._relay, name="console keys", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._wake)
        self._thread.join()
        if select.select([self._terminal], [], [], 0.0)[0]:
            self._take(os.read(self._terminal, 65536), drop=True)
        rows = os.get_terminal_size(self._terminal).lines
        self._write(b"\x1b7\x1b[r\x1b[%d;1H\x1b[2K\x1b8" % rows)
        termios.tcsetattr(self._terminal, termios.TCSANOW, self._before)
        os.dup2(self._terminal, self._input)
        for descriptor in (self._terminal, self._master, self._woken):
            os.close(descriptor)

    def _relay(self) -> None:
        while True:
            ready = select.select([self._terminal, self._master, self._woken], [], [], self._period)[0]
            if self._terminal in ready:
                keys = os.read(self._terminal, 1024)
                if not keys:  # the terminal is gone
                    return
                self._take(keys)
            elif self._pending == b"\x1b" and not ready:  # the key Esc
                self._pass(self._pending)
                self._pending = b""
            if self._master in ready:
                self._show_echo()
            if self._woken in ready:
                return
            self._draw()

    def _take(self, keys: bytes, *, drop: bool = False) -> None:
        number, others, self._pending = count_stops(self._pending + keys)
        for _ in range(number):
            self._on_stop()
        if not drop:
            self._pass(others)

    def _pass(self, keys: bytes) -> None:
        """Pass `keys` on to the command, and Ctrl-C as its signal, as a terminal does."""
        interrupt: bytes = self._before[6][termios.VINTR]
        for part in re.split(b"(%b|[\r\n])" % re.escape(interrupt), keys):
            if part == interrupt:
                os.killpg(os.getpgrp(), signal.SIGINT)
            elif part:
                if part in b"\r\n" and termios.tcgetattr(self._master)[3] & termios.ECHO:
                    # The command may print before the thread reads the echo of the line's end.
                    while select.select([self._master], [], [], _ECHO_TIMEOUT)[0]:
                        self._show_echo()
                    self._write(b"\n")
                    self._ended_lines += 1
                with suppress(BlockingIOError):  # more than anyone types
                    os.write(self._master, part)

    def _show_echo(self) -> None:
        """Show the echo of an answer, if there is one, without line ends that are shown already."""
        try:
            echo = os.read(self._master, 4096)
        except BlockingIOError:
            return
        ends = min(echo.count(b"\r\n"), self._ended_lines)
        self._ended_lines -= ends
        self._write(echo.replace(b"\r\n", b"", ends))

    def _draw(self) -> None:
        """Draw the last line; the command scrolls above it. One write is not torn by the command's."""
        columns, rows = os.get_terminal_size(self._terminal)
        has_line = rows >= _MIN_ROWS
        fcntl.ioctl(self._master, termios.TIOCSWINSZ, struct.pack("HHHH", rows - has_line, columns, 0, 0))
        if has_line:
            try:
                text = self._line(columns)
            except Exception as error:  # the stop key has to outlive a line that cannot be made
                text = f"no state: {type(error).__name__}"[:columns]
            line = text.encode(sys.stdout.encoding or "ascii", "replace")
            self._write(b"\x1b7\x1b[1;%dr\x1b[%d;1H\x1b[2K%b\x1b8" % (rows - 1, rows, line))

    def _write(self, output: bytes) -> None:
        os.write(self._terminal, output)


def _single_keys(settings: list[Any]) -> list[Any]:
    """Return terminal `settings` for single keys without echo and signals; output is unchanged."""
    characters = list(settings[6])
    characters[termios.VMIN], characters[termios.VTIME] = 1, 0
    inputs = settings[0] & ~(termios.ICRNL | termios.INLCR | termios.IGNCR | termios.IXON)
    lines = settings[3] & ~(termios.ICANON | termios.ECHO | termios.ISIG | termios.IEXTEN)
    return [inputs, settings[1], settings[2], lines, *settings[4:6], characters]
