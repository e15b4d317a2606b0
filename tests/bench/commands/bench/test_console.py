"""The console: the commands of the command line on one connection, and a key that stops."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import pytest
from prompt_toolkit.completion import CompleteEvent, DummyCompleter
from prompt_toolkit.document import Document
from prompt_toolkit.history import InMemoryHistory
from prompt_toolkit.input import create_pipe_input
from prompt_toolkit.input.base import PipeInput
from prompt_toolkit.output import DummyOutput

from bench.base.address import BenchAddress, free_port, load_address
from bench.base.errors import BenchError, ExitCode
from bench.base.lifecycle import Phase, Request, State
from bench.commands.bench import console
from bench.commands.bench.console import (
    CommandCompleter,
    CommandTerminal,
    ConsoleLines,
    KeptConnection,
    arguments_of,
    count_stops,
    history,
)
from bench.commands.cli import command_line
from bench.commands.common import Session
from bench.network.client import BenchClient
from bench.network.zenoh_session import NoAnswer
from tests.bench.fake_bench_service import (
    FakeDesk,
    RunningPlane,
    loopback_configuration,
    publishing,
    running_plane,
)
from tests.conftest import Run
from tests.running_bench import running_bench, write_configuration
from tests.waiting import wait_until

F8 = b"\x1b[19~"
LONGEST = 60.0
"""s that a step may take on a busy machine."""


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def file(port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write the configuration of a bench at `port`, for a user with new folders."""
    file = tmp_path / "bench.toml"
    network = f'[network]\nendpoint = "tcp/127.0.0.1:{port}"\n'
    file.write_text(f'base = "shipped"\n[bench]\ndata_dir = "{tmp_path}"\n{network}')
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return file


@contextmanager
def published_plane(port: int, state: State = State.ESTOP) -> Iterator[RunningPlane]:
    """Run a plane that publishes its state as a bench does."""
    with running_plane(FakeDesk(state), loopback_configuration(port)) as running, publishing(running):
        yield running


# Lines -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "arguments"),
    [
        ("", []),
        ("  arm --wait ", ["arm", "--wait"]),
        ("golfbench swing", ["swing"]),
        ("campaign mark x 'a gust'", ["campaign", "mark", "x", "a gust"]),
        ("help", ["--help"]),
        ("help arm", ["arm", "--help"]),
    ],
)
def test_arguments_of_line_returns_command_arguments(line: str, arguments: list[str]) -> None:
    assert arguments_of(line, command_line().commands) == arguments


@pytest.mark.parametrize(
    ("line", "location", "action"),
    [
        ("swng", "swng", "Did you mean swing?"),
        ("run", "run", "Start it in another terminal: golfbench run."),
        ("console", "console", "Start it in another terminal: golfbench console."),
        ("--config other.toml arm", "--config", "help lists all."),
        ("arm 'x", "arm 'x", "Add the closing quotation mark."),
    ],
)
def test_arguments_of_invalid_line_is_refused(line: str, location: str, action: str) -> None:
    with pytest.raises(BenchError) as refused:
        arguments_of(line, command_line().commands)
    assert (refused.value.location, refused.value.action) == (location, action)


@pytest.mark.parametrize(
    ("typed", "some", "never"),
    [
        ("cam", {"campaign"}, {"arm"}),
        ("golfbench ho", {"home"}, set()),
        ("r", {"reset", "replay"}, {"run"}),
        ("campaign ch", {"check"}, {"new"}),
        ("arm --w", {"--wait"}, {"--timeout"}),
        ("arm --wait --", {"--timeout"}, {"--wait"}),
        ("profile show t", {"tour-male", "tour-female"}, {"default"}),
        ("campaign check t", {"two-balls", "ten-balls"}, {"bag"}),
        ("campaign new x.toml --compare ", {"ball", "club", "swing"}, set()),
        ("campaign new x.toml --compare b", {"ball"}, {"club"}),
        ("campaign report ", set(), set()),
        ("--config be", set(), {"bench.toml"}),
        ("swing ", set(), {"list"}),
    ],
)
def test_command_completer_offers_commands_options_and_values(
    typed: str, some: set[str], never: set[str], file: Path
) -> None:
    completer = CommandCompleter(command_line(), Session(file))
    found = {one.text.strip() for one in completer.get_completions(Document(typed), CompleteEvent())}
    assert some <= found
    assert not never & found


def test_history_is_stored_in_private_file(file: Path, tmp_path: Path) -> None:
    history().append_string("status")
    stored = tmp_path / "state/golfbench/console_history"
    assert stored.stat().st_mode & 0o077 == 0
    assert list(history().load_history_strings()) == ["status"]
    stored.unlink()
    stored.mkdir()
    history().append_string("arm")


@pytest.fixture
def typed() -> Iterator[PipeInput]:
    with create_pipe_input() as typed:
        yield typed


def console_lines(typed: PipeInput, stops: list[float]) -> ConsoleLines:
    connection: Any = SimpleNamespace(stop=lambda: stops.append(time.monotonic()), line=lambda width: "")
    return ConsoleLines(connection, DummyCompleter(), InMemoryHistory(), typed, DummyOutput())


@pytest.mark.parametrize("key", [F8.decode(), "\x1c"])
def test_console_lines_stop_key_stops_and_keeps_line(typed: PipeInput, key: str) -> None:
    stops: list[float] = []
    lines = console_lines(typed, stops)
    typed.send_text(f"sta{key}")

    def finish() -> None:
        wait_until(lambda: stops)
        typed.send_text("tus\r")

    finishing = threading.Thread(target=finish)
    finishing.start()
    assert lines.read() == "status"
    finishing.join()
    assert len(stops) == 1


def test_console_lines_ctrl_c_clears_line_and_ctrl_d_ends(typed: PipeInput) -> None:
    lines = console_lines(typed, [])
    typed.send_text("swing\x03")
    threading.Timer(0.5, lambda: typed.send_text("arm\r")).start()
    assert lines.read() == "arm"
    typed.send_text("\x04")
    assert lines.read() is None


def test_console_lines_type_ahead_is_dropped_except_stop(typed: PipeInput) -> None:
    stops: list[float] = []
    lines = console_lines(typed, stops)
    typed.send_text(f"home\rswing\r{F8.decode()}")
    assert lines.read() == "home"
    threading.Timer(0.5, lambda: typed.send_text("status\r")).start()
    assert lines.read() == "status"
    assert len(stops) == 1


# The connection --------------------------------------------------------------------------------------


def test_kept_connection_failed_stop_is_shown(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(stopping: bool) -> NoReturn:
        raise RuntimeError("session closed")

    connection = KeptConnection(load_address(file))
    monkeypatch.setattr(connection, "client", broken)
    connection.stop()
    wait_until(lambda: connection.note == "STOP FAILED, use the emergency stop: RuntimeError")


def test_kept_connection_lost_connection_refuses_and_reconnects(port: int, file: Path) -> None:
    with KeptConnection(load_address(file)) as connection:
        with pytest.raises(NoAnswer):
            connection.client(stopping=False)
        connection.stop()
        wait_until(lambda: connection.note.startswith("STOP FAILED, use the emergency stop"))
        for state in (State.ARMED, State.READY):  # the second is a bench that started again
            with published_plane(port, state) as running:
                wait_until(lambda: connection.status)
                assert f"bench bench1  {state.name}" in connection.line(200)
                assert connection.client(stopping=False).status()["state"] == state.name
                connection.stop()
                wait_until(lambda: connection.note.startswith("STOP accepted after "))
                assert [what for what, _ in running.service.stops] == ["stop"]
                wait_until(lambda: "  FAULT  " in connection.line(200))
            wait_until(lambda: connection.status is None)
            assert "NO CONNECTION: last state 1 s ago, in FAULT before" in connection.line(200)
            began = time.monotonic()
            with pytest.raises(NoAnswer, match="last state 1 s ago"):
                connection.client(stopping=False)
            assert time.monotonic() - began < 0.5
            assert connection.line(20).count("\x1b") == 2


def test_kept_connection_silent_bench_accepts_stop(port: int, file: Path) -> None:
    with running_plane(FakeDesk(State.ARMED), loopback_configuration(port)) as running:
        with KeptConnection(load_address(file)) as connection:
            wait_until(lambda: connection._client)
            with pytest.raises(NoAnswer, match="connecting"):
                connection.client(stopping=False)
            connection.client(stopping=True).stop()
    assert len(running.service.stops) == 1


def test_console_session_uses_one_connection(
    port: int, file: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    opened: list[object] = []
    connect = BenchClient.connect

    def note_connection(address: BenchAddress) -> BenchClient:
        opened.append(address)
        return connect(address)

    monkeypatch.setattr(BenchClient, "connect", note_connection)
    day = ["", "swng", "lease take --holder Ann", "reset", "home", "stop", "reset", "home", "arm", "tee now"]
    day += ["golfbench swing", "campaign watch", "status --json", "exit", "arm"]
    lines = iter(day)
    monkeypatch.setattr(console, "require_terminal", lambda: None)
    monkeypatch.setattr(console, "CommandTerminal", lambda *_: nullcontext())
    monkeypatch.setattr(console, "ConsoleLines", lambda *_: SimpleNamespace(read=lambda: next(lines)))
    with published_plane(port) as running:
        code, out, err = run("--config", file, "console")
    assert code == 0
    assert len(opened) == 1
    expected = [Request.RESET, Request.HOME, Request.RESET, Request.HOME, Request.ARM, Request.SWING]
    assert running.service.requests == expected
    assert next(lines) == "arm"
    assert "swing 1: 43.05 m/s" in out
    assert '"state": "READY"' in out
    assert re.search(r"bench bench1: Ann holds it for (29|30) s more, then it disarms\n$", out)
    assert err.startswith("error: swng\n  found:    not a command\n")
    assert "no runner publishes it" in err


# The terminal ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "found"),
    [
        (b"\x1b[19~", (1, b"", b"")),
        (b"\x1b[19;5~\x1c", (2, b"", b"")),
        (b"y\x1b[19~\r", (1, b"y\r", b"")),
        (b"\x1b[A\x1b[18~8", (0, b"\x1b[A\x1b[18~8", b"")),
        (b"a\x1b", (0, b"a", b"\x1b")),
        (b"a\x1b[1", (0, b"a", b"\x1b[1")),
        (b"[19~", (1, b"", b"")),
        (b"19~", (0, b"19~", b"")),
    ],
)
def test_count_stops_finds_stop_keys_among_others(keys: bytes, found: tuple[int, bytes, bytes]) -> None:
    assert count_stops(keys) == found


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Stand for the process's terminal; yield its other end."""
    master, slave = pty.openpty()
    termios.tcsetwinsize(slave, (24, 80))
    with os.fdopen(slave, "r") as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        yield master
    os.close(master)


def test_command_terminal_separates_stop_key_from_command_input(terminal: int) -> None:
    stops: list[float] = []
    before = termios.tcgetattr(sys.stdin.fileno())
    with CommandTerminal(lambda: stops.append(time.monotonic()), lambda width: "READY"[:width], 0.02):
        assert sys.stdin.isatty()
        assert os.get_terminal_size(sys.stdin.fileno()).lines == 23
        os.write(terminal, b"y\x1b[1")
        time.sleep(0.005)
        os.write(terminal, b"9~es\r")
        assert sys.stdin.readline() == "yes\n"
        wait_until(lambda: stops)
        os.write(terminal, b"swing\rhome")
        time.sleep(0.1)
        shown = os.read(terminal, 65536).decode()
        assert "\x1b[1;23r\x1b[24;1H\x1b[2KREADY\x1b8" in shown
        assert re.sub(r"\x1b7.*?\x1b8", "", shown) == "\r\n\x1b[Ayes\r\nswing\r\nhome"
        os.write(terminal, F8)
    assert len(stops) == 2  # of which one at the very end
    assert termios.tcgetattr(sys.stdin.fileno()) == before
    os.write(terminal, b"status\r")
    assert sys.stdin.readline() == "status\n"  # unread keys are gone


def test_command_terminal_failed_state_line_keeps_stop_key(terminal: int) -> None:
    stops: list[None] = []

    def broken(_: int) -> str:
        raise KeyError("lease")

    with CommandTerminal(lambda: stops.append(None), broken, 0.02):
        time.sleep(0.1)
        os.write(terminal, F8)
        wait_until(lambda: stops)
        assert b"no state: KeyError" in os.read(terminal, 65536)


def test_command_terminal_ctrl_c_sends_sigint(terminal: int, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[int] = []
    monkeypatch.setattr(os, "killpg", lambda group, number: sent.append(number))
    with CommandTerminal(lambda: None, lambda width: "", 0.02):
        os.write(terminal, b"\x03")
        wait_until(lambda: sent)
    assert sent == [signal.SIGINT]


@pytest.mark.parametrize("stream", ["stdin", "stdout"])
def test_console_without_terminal_is_refused(
    stream: str, terminal: int, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    if stream == "stdin":
        monkeypatch.setattr("sys.stdin", StringIO())
    code, _, said = run("console")
    assert code == ExitCode.BAD_INPUT
    assert said.startswith(f"error: golfbench console\n  found:    standard {stream[3:]}put is no terminal\n")
    assert "  action:   In scripts use single commands" in said


class ConsoleProcess:
    """`golfbench console` as a person has it."""

    def __init__(self, file: Path) -> None:
        self._master, slave = pty.openpty()
        termios.tcsetwinsize(slave, (30, 160))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bench", "--config", str(file), "console"],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            env=os.environ | {"TERM": "xterm", "PROMPT_TOOLKIT_NO_CPR": "1"},
        )
        os.close(slave)
        self.shown = ""
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def _read(self) -> None:
        with suppress(OSError):  # the console has ended
            while found := os.read(self._master, 65536):
                self.shown += found.decode(errors="replace")

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def line(self, text: str, *, answer: str) -> None:
        """Enter a line, and wait for an answer and the next prompt."""
        before = len(self.shown)
        self.type(text.encode() + b"\r")
        self.wait_for(answer, before)

    def wait_for(self, answer: str, before: int = 0) -> None:
        """Wait for `answer` and the next prompt, in the output from `before` on."""
        wait_until(lambda: answer in self.shown[before:])
        at = self.shown.index(answer, before)
        wait_until(lambda: "golfbench>" in self.shown[at:])
        time.sleep(0.1)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reading.join()
        os.close(self._master)


@contextmanager
def console_process(file: Path) -> Iterator[ConsoleProcess]:
    process = ConsoleProcess(file)
    try:
        wait_until(lambda: "golfbench>" in process.shown)
        time.sleep(0.2)
        yield process
    finally:
        process.close()


def test_console_stop_key_stops_waiting_command_and_drops_input(port: int, file: Path) -> None:
    with published_plane(port, State.READY) as running, console_process(file) as shown:
        service = running.service
        service.vents = 10**9  # arm is retried
        shown.line("lease take", answer="each command renews it")
        shown.type(b"arm --wait\r")
        wait_until(lambda: Request.ARM in service.requests)
        shown.type(b"swing\r")
        shown.type(F8)
        wait_until(lambda: service.stops)
        shown.wait_for("refused in state FAULT")
        service.state = State.READY
        shown.line("status --json", answer='"state": "READY"')
        asked = len(service.requests)
        shown.type(b"arm --wait\r")
        wait_until(lambda: len(service.requests) > asked)
        shown.type(b"\x03")
        shown.wait_for("only the waiting ended")
        shown.line("lease release", answer="lease released")
        shown.type(b"\x04")
        assert shown.process.wait(LONGEST) == 0
        assert set(service.requests) == {Request.ARM}
        assert len(service.stops) == 1


@pytest.mark.live
@pytest.mark.paced
@pytest.mark.timeout(900)
def test_console_stop_key_stops_swing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / name))
    file = write_configuration(tmp_path, "console")
    with running_bench(file) as bench, console_process(file) as shown:
        shown.line("lease take --seconds 600", answer="each command renews it")
        shown.line("reset", answer=": SAFE.")
        shown.line("home --wait", answer=": READY.")
        shown.line("arm --wait", answer=": ARMED.")
        assert not re.search(r"\d sbench", shown.shown)  # the line of the waiting has ended
        shown.type(b"swing\r")
        bench.wait_phase(Phase.BACKSWING)
        shown.type(F8)
        wait_until(lambda: bench.cause == "OPERATOR_STOP")
        shown.wait_for("stopped by the operator")
        shown.type(b"\x04")
        assert shown.process.wait(LONGEST) == 0
