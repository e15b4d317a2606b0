"""Commands of the command line, run by the page: it can do nothing there that `golfbench` cannot.

Each is a separate process with the page's configuration, so that neither its work nor its end affects the
page: a stop never waits for one. Arguments are passed as a list, never through a shell.

A background command, a campaign's runner or a commissioning, outlives the page. It has a separate session:
neither Ctrl-C at the page nor the page's end reaches it. Its output goes to a file, not to a pipe that would
break. A page that is started later finds it by its lock, its publications or its stored results, as any
other one. The unit of the page has KillMode=process for the same reason.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from threading import BoundedSemaphore, Lock, Thread
from typing import Any

from bench.base.errors import FOR_PROGRAMS, BenchError, Refused

NICE = 10
"""Nice value of a command, equal to that of the page's service."""
MAX_COMMANDS = 2
COMMAND_TIMEOUT = 180.0
"""Time after which a command is ended, s."""
_MAX_WORDS_LENGTH = 2000


class CommandLine:
    """The command line with one configuration."""

    def __init__(self, golfbench: Sequence[str]) -> None:
        """`golfbench` is the program with its global options."""
        self._golfbench = tuple(golfbench)
        self._free = BoundedSemaphore(MAX_COMMANDS)
        self._running: set[subprocess.Popen[bytes]] = set()
        self._closed, self._lock = False, Lock()

    def arguments(self, *arguments: str) -> list[str]:
        """Return program and `arguments`."""
        return [*self._golfbench, *arguments]

    def output(self, *arguments: str, passed: Collection[int] = (0,)) -> str:
        """Run a command to its end; return its output if it ends with one of the codes `passed`.

        Raises:
            BenchError: the command refuses, in its own words; too many run at a time; it does not end.
        """
        location = f"golfbench {arguments[0]}"
        if not self._free.acquire(blocking=False):
            expected, action = f"at most {MAX_COMMANDS} commands", "Retry when a command has ended."
            raise Refused(location, "too many commands at a time", expected, action)
        try:
            code, output, said = self._run(location, self.arguments(*arguments))
        finally:
            self._free.release()
        if code not in passed or (code and faults_in(said)):
            raise fault_of(location, code, said)
        return output

    def close(self) -> None:
        """End the commands that run."""
        with self._lock:
            self._closed = True
            for process in self._running:
                process.terminate()

    def _run(self, location: str, arguments: Sequence[str]) -> tuple[int, str, str]:
        """Return exit code, output and errors of a program."""
        with self._lock:
            if self._closed:
                raise Refused(location, "the page ends", "a running page", "Start the page again.")
            process = spawned(arguments, subprocess.PIPE, subprocess.PIPE)
            self._running.add(process)
        try:
            output, said = process.communicate(timeout=COMMAND_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            expected = f"an end within {COMMAND_TIMEOUT:g} s"
            raise BenchError(location, "still running", expected, "Use the command line.") from None
        finally:
            with self._lock:
                self._running.discard(process)
        return process.returncode, output.decode("utf-8", "replace"), said.decode("utf-8", "replace")


def spawned(arguments: Sequence[str], output: Any, errors: Any) -> subprocess.Popen[bytes]:
    """Start a program in its own session with the priority NICE, and errors for programs; return it."""
    process = subprocess.Popen(
        arguments,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=errors,
        start_new_session=True,
        env={**os.environ, FOR_PROGRAMS: "json", "NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "400"},
    )
    with suppress(OSError):  # never above the page's own
        os.setpriority(os.PRIO_PROCESS, process.pid, max(NICE, os.getpriority(os.PRIO_PROCESS, process.pid)))
    return process


def faults_in(text: str) -> list[BenchError]:
    """Return the errors that a command printed into `text`, each a JSON object in a line."""
    found = []
    for line in text.splitlines():
        with suppress(ValueError, TypeError):  # another line
            found.append(BenchError(**json.loads(line)))
    return found


def fault_of(location: str, code: int, text: str) -> BenchError:
    """Return the error that a command ended with, from its exit `code` and its output `text`."""
    faults = faults_in(text)
    if len(faults) == 1:
        return faults[0]
    if faults:
        action = _cut(" ".join(dict.fromkeys(one.action for one in faults)))
        if len({(one.location, one.expected) for one in faults}) == 1:
            found = _cut("; ".join(one.found for one in faults))
            return BenchError(faults[0].location, found, faults[0].expected, action)
        found = "; ".join(f"{one.location}: {one.found}, expected {one.expected}" for one in faults)
        return BenchError(location, _cut(found), "a valid input", action)
    said = text.strip().rpartition("\n")[2]
    action = "See it at the command line."
    return BenchError(location, f"exit code {code}{f': {_cut(said)}' if said else ''}", "exit code 0", action)


def _cut(text: str) -> str:
    return text if len(text) <= _MAX_WORDS_LENGTH else f"{text[:_MAX_WORDS_LENGTH]} ..."


_TAIL = 20_000
"""Size of the end of the log that is read for the reason of an end, bytes."""


class BackgroundCommand:
    """Starts commands of one kind, one at a time, and publishes how the newest one ended."""

    def __init__(
        self,
        golfbench: CommandLine,
        log: Path,
        publish: Callable[[str, Any], None],
        topic: str,
        *,
        expected: Collection[int] = (0,),
        outcome: Callable[[dict[str, Any]], str] | None = None,
    ) -> None:
        """`log` is the file for a command's messages and errors; `publish` gets `topic` and content.

        An end with one of the `expected` exit codes gets a text only if an error was printed. If the command
        ends otherwise without a message, `outcome` returns the text from its JSON, which is stored next to
        the log.
        """
        self._golfbench, self._log, self._publish = golfbench, log, publish
        self._topic, self._expected, self._outcome = topic, frozenset(expected), outcome
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = Lock()

    def start(self, what: str, *arguments: str) -> None:
        """Start `golfbench` with `arguments` for `what`.

        Raises:
            Refused: the command before has not ended.
            BenchError: it cannot be started.
        """
        with self._lock:
            if self._process is not None and self._process.poll() is None:
                found = f"process {self._process.pid}, started on this page"
                raise Refused(self._topic, found, f"no other {self._topic}", "Wait for it, or stop it.")
            self._process = self._started(self._golfbench.arguments(*arguments))
            self._publish(self._topic, {"what": what, "running": True, "text": ""})
            Thread(
                target=self._wait, args=(self._process, what), name=f"page-{self._topic}", daemon=True
            ).start()

    def _started(self, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        try:
            self._log.parent.mkdir(parents=True, exist_ok=True)
            with self._log.open("wb") as log, self._log.with_suffix(".json").open("wb") as output:
                return spawned(arguments, output, log)
        except OSError as error:
            action = "Look at golfbench doctor."
            raise BenchError(
                str(self._log), error.strerror or str(error), f"a {self._topic}", action
            ) from error

    def _wait(self, process: subprocess.Popen[bytes], what: str) -> None:
        code = process.wait()
        text = "" if code == 0 else self._said(what, code)
        self._publish(self._topic, {"what": what, "running": False, "text": text})

    def _said(self, what: str, code: int) -> str:
        """Return why the command ended with `code`; empty for an expected end without an error."""
        try:
            with self._log.open("rb") as stream:
                stream.seek(max(0, self._log.stat().st_size - _TAIL))
                text = stream.read().decode("utf-8", "replace")
        except OSError as error:
            return f"{what} ended with {code}; its log cannot be read: {error.strerror}"
        if not faults_in(text):
            if code in self._expected:
                return ""
            if self._outcome is not None:
                with suppress(OSError, ValueError):  # ended before it printed
                    return self._outcome(json.loads(self._log.with_suffix(".json").read_bytes()))
        fault = fault_of(what, code, text)
        return f"{fault.location}: {fault.found}; expected {fault.expected}. {fault.action}"


TOPIC = "viewer"
"""Topic on which the page publishes whether the viewer runs."""
START = 120.0
"""Time within which the viewer is to listen, s; the first start compiles."""
_END = 10.0
_LOOK = 0.1
_MAX_OUTPUT_LENGTH = 20_000
_URL = re.compile(r"http://127\.0\.0\.1:[0-9]{1,5}/\?url=[A-Za-z0-9%._~+-]+")


class ViewerProcess:
    """Rerun's viewer of the running bench, `golfbench view --web`, while there is one.

    It starts when it is first opened and ends with the page. It subscribes to the bench's publications, as
    any viewer does: the loop is not affected.
    """

    def __init__(self, golfbench: CommandLine, publish: Callable[[str, Any], None]) -> None:
        """`publish` takes a topic and its content."""
        self._golfbench, self._publish = golfbench, publish
        self._process: subprocess.Popen[bytes] | None = None
        self._url = ""
        self._lock = Lock()
        publish(TOPIC, {"open": False})

    def url(self) -> str:
        """Return the URL of the viewer, which is started unless it runs.

        Raises:
            BenchError: it does not start, in its own words.
        """
        with self._lock:
            if self._process is None or self._process.poll() is not None or not self._url:
                self._end()
                self._url = self._started()
                self._publish(TOPIC, {"open": True})
            return self._url

    def close(self) -> None:
        """End the viewer, also while it starts. Allowed twice."""
        if (process := self._process) is not None:
            process.terminate()
        with self._lock:
            self._end()
            self._publish(TOPIC, {"open": False})

    def _started(self) -> str:
        """Start the viewer; return the URL that it prints."""
        with TemporaryFile() as said:
            arguments = self._golfbench.arguments("view", "--web")
            self._process = process = spawned(arguments, said, subprocess.STDOUT)
            deadline = time.monotonic() + START
            while True:
                running = process.poll() is None
                text = os.pread(said.fileno(), _MAX_OUTPUT_LENGTH, 0).decode("utf-8", "replace")
                if url := _URL.search(text):
                    return url[0]
                if not running or time.monotonic() > deadline:
                    break
                time.sleep(_LOOK)
        self._end()
        if running:
            raise BenchError("viewer", "no URL", f"one within {START:g} s", "Try golfbench view --web.")
        raise fault_of("viewer", process.returncode, text)

    def _end(self) -> None:
        process, self._process, self._url = self._process, None, ""
        if process is None:
            return
        process.terminate()
        try:
            process.wait(_END)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
