"""`golfbench console`: the commands of the command line on one kept connection, with a key that stops.

While a command runs, a thread reads the keys and passes them on to it through a pseudo-terminal, and the last
line shows the state. Questions, the key that marks a shot, and Ctrl-C work as outside the console. Keys that
the command does not read are dropped: a line typed ahead never moves the robot.
"""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import shlex
import signal
import struct
import sys
import termios
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, Self

import typer
from prompt_toolkit import PromptSession
from prompt_toolkit.completion import CompleteEvent, Completer, Completion, PathCompleter
from prompt_toolkit.document import Document
from prompt_toolkit.formatted_text import ANSI
from prompt_toolkit.history import FileHistory, History, InMemoryHistory
from prompt_toolkit.input import Input
from prompt_toolkit.input.typeahead import clear_typeahead, get_typeahead
from prompt_toolkit.key_binding import KeyBindings
from prompt_toolkit.keys import Keys
from prompt_toolkit.output import Output
from prompt_toolkit.styles import Style

from bench.base.errors import BenchError, ExitCode, did_you_mean
from bench.base.lifecycle import LATCHED, MOVING, State, in_one
from bench.commands.bench.status_table import REDRAW, SILENT
from bench.network.client import BenchClient
from bench.network.status_words import sentence, state_words
from bench.network.zenoh_session import NoAnswer

if TYPE_CHECKING:
    from typer.core import TyperGroup

    from bench.base.address import BenchAddress
    from bench.commands.common import Session
    from bench.network.bench_service import BenchStatus

ELSEWHERE = frozenset({"console", "nodes", "page", "run"})
"""Commands that run until they are ended, and so need a separate terminal."""
_FIRST_STATE = 2.0
"""Max time for the first state (s)."""
_STOPS = (Keys.F8, Keys.ControlBackslash)

_RETRY_DELAY = 1.0
"""Time between two attempts to connect (s)."""
STOP_KEYS = "F8 or Ctrl-\\"
_PLAIN, _GREEN, _YELLOW, _RED = "7", "30;42", "30;43", "1;97;41"
"""Attributes of the state line at a terminal; yellow: the robot moves or may move."""

Report = Callable[[Callable[[], object], "Session"], int]
"""Does the work of a command, prints its error and returns its exit code."""


class KeptConnection:
    """One connection to a bench, with its newest state; a context."""

    def __init__(self, address: BenchAddress) -> None:
        self.note = ""
        """Result of the newest stop by key."""
        self._address = address
        self._client: BenchClient | None = None
        self._status: BenchStatus | None = None
        self._received_at = time.monotonic()
        self._error: BenchError | None = None
        """Why there is no connection."""
        self._ended = Event()
        self._thread = Thread(target=self._follow, name="console connection", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(SILENT)
        if self._client is not None:
            self._client.close()

    @property
    def status(self) -> BenchStatus | None:
        """The newest state; None before the first and while the bench is silent."""
        return None if time.monotonic() - self._received_at > SILENT else self._status

    def wait(self, timeout: float) -> None:
        """Wait up to `timeout` (s) for the first state."""
        end = time.monotonic() + timeout
        while self._status is None and time.monotonic() < end:
            time.sleep(0.01)

    def client(self, stopping: bool) -> BenchClient:
        """Return a client without a lease on the connection; not to be closed.

        Raises:
            NoAnswer: there is no connection, or the bench is silent and this is not for `stopping`.
        """
        if self._client is not None and (stopping or self.status is not None):
            return self._client.sibling()
        if self._client is None and self._error is not None:
            raise self._error
        raise NoAnswer(self._address.bench.id, self._address.network.endpoint, self._silence())

    def stop(self) -> None:
        """Stop the robot at once, in a new thread; the state line shows the result."""
        Thread(target=self._stop, args=(time.monotonic(),), name="console stop", daemon=True).start()

    def _stop(self, pressed_at: float) -> None:
        self.note = "STOP sent"
        try:
            self.client(stopping=True).stop()
        except Exception as error:  # whatever failed, the person has to know it
            reason = error.found if isinstance(error, BenchError) else type(error).__name__
            self.note = f"STOP FAILED, use the emergency stop: {reason}"
        else:
            self.note = f"STOP accepted after {1e3 * (time.monotonic() - pressed_at):.0f} ms"

    def line(self, width: int) -> str:
        """Return the state line for a terminal `width` columns wide, with its attributes."""
        text, attributes = self._state()
        parts = f"STOP: {STOP_KEYS}", self.note, f"bench {self._address.bench.id}", text
        shown = f" {'  '.join(filter(None, parts))}"
        return f"\x1b[0;{attributes}m{shown[:width]:<{width}}\x1b[0m"

    def _state(self) -> tuple[str, str]:
        status = self.status
        if status is None:
            before = f", in {self._status['state']} before" if self._status else ""
            return f"NO CONNECTION: {self._silence()}{before}", _RED
        state, lease, cause = State[status["state"]], status["lease"], status["cause"]
        fact = sentence(in_one((cause["text"], cause["action"]))) if cause else state_words(status)
        held = f"lease {lease['holder']} {lease['seconds_left']:.0f} s" if lease else "no lease"
        ball = "" if state is not State.ARMED else "  ball" if status["ball_present"] else "  no ball"
        attributes = _RED if state in LATCHED else _YELLOW if state in MOVING else _GREEN
        return f"{state.name}{ball}  swings {status['swings']}  {held}  {fact}", attributes

    def _silence(self) -> str:
        if self._status is None:
            return self._error.found if self._error else "connecting"
        return f"last state {time.monotonic() - self._received_at:.0f} s ago"

    def _follow(self) -> None:
        """Connect, retry until it succeeds, and receive states; a lost connection is renewed by zenoh."""
        while not self._ended.is_set():
            try:
                if self._client is None:
                    self._client = BenchClient.connect(self._address)
                self._receive(self._client)
            except BenchError as error:
                self._error = error
                self._ended.wait(_RETRY_DELAY)

    def _receive(self, client: BenchClient) -> None:
        with closing(client.states(REDRAW)) as states:
            for received in states:
                if received is not None:
                    self._status, self._received_at = received, time.monotonic()
                if self._ended.is_set():
                    return


def require_terminal() -> None:
    """Raise BenchError unless keyboard and screen are a terminal."""
    for name, stream in (("input", sys.stdin), ("output", sys.stdout)):
        if stream is None or not stream.isatty():
            expected = "a terminal: its stop key is a key"
            action = "In scripts use single commands, such as golfbench status --json."
            raise BenchError("golfbench console", f"standard {name} is no terminal", expected, action)


def run_console(session: Session, group: TyperGroup, report: Report) -> None:
    """Read lines and run them as commands of `group`, until Ctrl-D or `exit`.

    Raises:
        BenchError: standard input or output is no terminal.
    """
    require_terminal()
    with KeptConnection(session.address()) as connection:
        kept = replace(session, kept=connection.client)
        lines = ConsoleLines(connection, CommandCompleter(group, kept), history())
        connection.wait(_FIRST_STATE)
        # Between a line and its command the terminal sends Ctrl-\ as a signal.
        before = signal.signal(signal.SIGQUIT, lambda *_: connection.stop())
        typer.echo(f"{STOP_KEYS} stops the robot at any time. Ctrl-C ends the waiting, Ctrl-D the console.")
        while (line := lines.read()) is not None:
            connection.note = ""
            with suppress(KeyboardInterrupt):  # Ctrl-C ends a command only
                if _run_line(line, group, kept, report, connection) in (None, ExitCode.TERMINATED):
                    break
        status = connection.status
        signal.signal(signal.SIGQUIT, before)
    if status is not None and (lease := status["lease"]) is not None:
        left = f"{lease['seconds_left']:.0f} s"
        typer.echo(f"bench {status['bench']}: {lease['holder']} holds it for {left} more, then it disarms")


def _run_line(
    line: str, group: TyperGroup, session: Session, report: Report, connection: KeptConnection
) -> int | None:
    """Run `line`; return its exit code, None for the end of the console."""
    if line.strip() == "exit":
        return None
    options = ["--config", str(session.config)] if session.config else []
    options += ["--debug"] if session.debug else []

    def work() -> None:
        if arguments := arguments_of(line, group.commands):
            with CommandTerminal(connection.stop, connection.line, REDRAW):
                group.main(args=[*options, *arguments], prog_name="golfbench", obj=session)

    return report(work, session)


def arguments_of(line: str, commands: Mapping[str, object]) -> list[str]:
    """Return the words of `line`, without a leading "golfbench"; `help` is `--help`.

    Raises:
        BenchError: it is no command of the console.
    """
    try:
        words = shlex.split(line)
    except ValueError as error:
        raise BenchError(line.strip(), str(error), "a command", "Add the closing quotation mark.") from None
    if words[:1] == ["golfbench"]:
        del words[0]
    if not words:
        return words
    if words[0] == "help":
        return [*words[1:], "--help"]
    if words[0] in ELSEWHERE:
        action = f"Start it in another terminal: golfbench {words[0]}."
        raise BenchError(words[0], "a command that runs until it is ended", "a command that ends", action)
    if words[0] not in commands:
        raise BenchError(
            words[0], "not a command", "a command", did_you_mean(words[0], commands, "help lists all.")
        )
    return words


class ConsoleLines:
    """Lines typed at the console, with history, completion, state line and stop key."""

    def __init__(
        self,
        connection: KeptConnection,
        completer: Completer,
        past: History,
        terminal: Input | None = None,
        screen: Output | None = None,
    ) -> None:
        """`terminal` and `screen` are those of the process unless given."""
        self._stop, keys = connection.stop, KeyBindings()
        for key in _STOPS:
            keys.add(key, eager=True)(lambda _: connection.stop())
        self._prompt: PromptSession[str] = PromptSession(
            "golfbench> ",
            completer=completer,
            complete_while_typing=False,
            complete_in_thread=True,
            history=past,
            key_bindings=keys,
            bottom_toolbar=lambda: ANSI(connection.line(self._prompt.output.get_size().columns)),
            refresh_interval=REDRAW,
            style=Style.from_dict({"bottom-toolbar": "noreverse"}),
            input=terminal,
            output=screen,
        )

    def read(self) -> str | None:
        """Return the next line, None at Ctrl-D; keys typed before it was read are dropped, but a stop key."""
        while True:
            if any(press.key in _STOPS for press in get_typeahead(self._prompt.input)):
                self._stop()
            clear_typeahead(self._prompt.input)
            try:
                return self._prompt.prompt()
            except KeyboardInterrupt:  # clears the line
                continue
            except EOFError:
                return None


def history() -> History:
    """Return the lines of earlier consoles, in a file that only its user can read."""
    state = os.environ.get("XDG_STATE_HOME")
    file = (Path(state) if state else Path.home() / ".local" / "state") / "golfbench" / "console_history"
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        os.close(os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
    except OSError:
        return InMemoryHistory()
    return FileHistory(file)


class CommandCompleter(Completer):
    """Completes commands, options and known values, as the command line declares them."""

    def __init__(self, group: TyperGroup, session: Session) -> None:
        self._group, self._session, self._paths = group, session, PathCompleter(expanduser=True)

    def get_completions(self, document: Document, complete_event: CompleteEvent) -> Iterator[Completion]:
        """Yield the completions of the word at the cursor."""
        before = document.text_before_cursor
        words, part = before.split(), ""
        if words and not before[-1].isspace():
            part = words.pop()
        if words[:1] == ["golfbench"]:
            del words[0]
        command: Any = self._group
        while words and (below := getattr(command, "commands", {}).get(words[0])):
            command = below
            del words[0]
        for name, below in getattr(command, "commands", {}).items():
            if name.startswith(part) and not (command is self._group and name in ELSEWHERE):
                yield _completion(name, part, below.get_short_help_str())
        yield from self._parameters(command, words, part, complete_event)

    def _parameters(
        self, command: Any, words: Sequence[str], part: str, event: CompleteEvent
    ) -> Iterator[Completion]:
        context = typer.Context(command, obj=self._session)
        parameters = command.get_params(context)
        options = {
            name: one for one in parameters for name in (*one.opts, *one.secondary_opts) if name[0] == "-"
        }
        if part.startswith("-"):
            for name, option in options.items():
                if name.startswith(part) and (option.multiple or name not in words):
                    yield _completion(name, part, (option.help or "").replace("\\[", "["))
            return
        wanted = _wanted(words, options, [one for one in parameters if one.param_type_name == "argument"])
        if wanted is None:
            return
        with suppress(BenchError, ExceptionGroup):  # configuration or database: its command reports it
            yield from [_completion(item.value, part) for item in wanted.shell_complete(context, part)]
        if "Path" in str(wanted.type_descriptor.annotation):
            yield from self._paths.get_completions(Document(part), event)


def _completion(text: str, part: str, about: str = "") -> Completion:
    return Completion(f"{text} ", -len(part), display=text, display_meta=about)


def _wanted(words: Sequence[str], options: Mapping[str, Any], arguments: Sequence[Any]) -> Any:
    """Return the option or argument that takes the value after `words`; None if none does."""
    taken, open_option = 0, None
    for word in words:
        if open_option is not None:
            open_option = None
        elif (option := options.get(word)) is not None:
            open_option = None if option.is_flag else option
        else:
            taken += 1
    if open_option is not None:
        return open_option
    if taken < len(arguments):
        return arguments[taken]
    return arguments[-1] if arguments and arguments[-1].nargs == -1 else None


# The terminal while a command runs -------------------------------------------------------------------

_STOP_BYTES = re.compile(rb"\x1b?\[19(;\d+)?~|\x1c")
"""Bytes of the stop keys: F8, also with Shift, Alt or Ctrl, and after a late Esc; Ctrl-\\."""
_UNFINISHED = re.compile(rb"\x1b(\[(1(9(;\d*)?)?)?)?$")
"""Start of F8 at the end of the keys."""
_ECHO_TIMEOUT = 0.02
"""Max time until the echo of a key arrives (s)."""
_MIN_ROWS = 5
"""Height of a terminal from which its last line shows the state."""


def count_stops(keys: bytes) -> tuple[int, bytes, bytes]:
    """Return how often `keys` have a stop key, the other keys, and those that may become one."""
    rest, number = _STOP_BYTES.subn(b"", keys)
    unfinished = _UNFINISHED.search(rest)
    at = unfinished.start() if unfinished else len(rest)
    return number, rest[:at], rest[at:]


class CommandTerminal:
    """Stands between terminal and command for a `with`."""

    def __init__(self, on_stop: Callable[[], None], line: Callable[[int], str], period: float) -> None:
        """`on_stop` is called at each stop key; `line` returns the status line, drawn every `period` s."""
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
