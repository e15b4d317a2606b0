"""A `golfbench` command that was started on the page and outlives it: a campaign's runner, a commissioning.

Its session is its own, so that neither Ctrl-C at the page nor the page's death reaches it, and what it
prints goes to a file, not to a pipe that would break. A page that is started later finds it as any other
one: by its lock, what it publishes or what it has stored. The unit of the page has KillMode=process for the
same reason. It ends as at the command line: when it is done, by its own stop, or by SIGTERM.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from bench.errors import BenchError, Refused
from bench.page.command_line import CommandLine, fault_of, faults_in, lower_priority, plain_environment

_TAIL = 20_000
"""Size of the end of the log that is read for the reason of an end, bytes."""


class BackgroundCommand:
    """Starts commands of one kind, one at a time, and says how the newest one ended."""

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
        """`log` is the file for what a command says, its errors too; `publish` gets `topic` and content.

        An end with one of the `expected` exit codes is said in words only if an error was printed. Another
        end without one is said by `outcome` of the JSON that the command prints, which goes beside the log.
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
                process = subprocess.Popen(
                    arguments,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=log,
                    start_new_session=True,
                    env=plain_environment(),
                )
        except OSError as error:
            cure = "Look at golfbench doctor."
            raise BenchError(
                str(self._log), error.strerror or str(error), f"a {self._topic}", cure
            ) from error
        lower_priority(process.pid)
        return process

    def _wait(self, process: subprocess.Popen[bytes], what: str) -> None:
        """Publish how `process` ended."""
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
        return f"{fault.place}: {fault.found}; expected {fault.expected}. {fault.cure}"
