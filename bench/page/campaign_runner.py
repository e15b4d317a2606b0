"""The runner of a campaign that was started on the page: a `golfbench campaign run` of its own.

It outlives the page. Its session is its own, so that neither Ctrl-C at the page nor the page's death
reaches it, and what it prints goes to a file, not to a pipe that would break. A page that is started later
finds it as any other runner: by what it publishes, its lock and the database. The unit of the page has
KillMode=process for the same reason. It ends as at the command line: by stop and abort on any page, or by
SIGTERM.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from bench.errors import BenchError, Refused
from bench.page.command_line import CommandLine, fault_of, lower_priority, plain_environment

TOPIC = "runner"
"""Topic on which the page publishes the newest runner that it started."""
_TAIL = 20_000
"""Size of the end of the log that is read for the reason of an end, bytes."""


class CampaignRunner:
    """Starts runners of campaigns, one at a time, and says how the newest one ended."""

    def __init__(self, golfbench: CommandLine, log: Path, publish: Callable[[str, Any], None]) -> None:
        """`log` is the file for what a runner prints; `publish` gets topic and content."""
        self._golfbench, self._log, self._publish = golfbench, log, publish
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = Lock()

    def start(self, what: str, *arguments: str) -> str:
        """Start `golfbench campaign` with `arguments` for `what`; return what happens.

        Raises:
            Refused: the runner before has not ended.
            BenchError: it cannot be started.
        """
        with self._lock:
            if self._process is not None and self._process.poll() is None:
                found = f"process {self._process.pid}, started on this page"
                raise Refused("runner", found, "no other runner", "Wait for it, or stop its campaign.")
            self._process = self._started(self._golfbench.arguments("campaign", *arguments))
            self._publish(TOPIC, {"what": what, "running": True, "text": ""})
            Thread(target=self._wait, args=(self._process, what), name="page-runner", daemon=True).start()
        return f"{what}: its runner starts, checks plan and bench, then takes the bench"

    def _started(self, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        try:
            self._log.parent.mkdir(parents=True, exist_ok=True)
            with self._log.open("wb") as output:
                process = subprocess.Popen(
                    arguments,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    env=plain_environment(),
                )
        except OSError as error:
            cure = "Look at golfbench doctor."
            raise BenchError(str(self._log), error.strerror or str(error), "a runner", cure) from error
        lower_priority(process.pid)
        return process

    def _wait(self, process: subprocess.Popen[bytes], what: str) -> None:
        """Publish how `process` ended."""
        code = process.wait()
        text = "" if code == 0 else self._said(what, code)
        self._publish(TOPIC, {"what": what, "running": False, "text": text})

    def _said(self, what: str, code: int) -> str:
        try:
            with self._log.open("rb") as stream:
                stream.seek(max(0, self._log.stat().st_size - _TAIL))
                text = stream.read().decode("utf-8", "replace")
        except OSError as error:
            return f"{what} ended with {code}; its log cannot be read: {error.strerror}"
        fault = fault_of(what, code, text)
        return f"{fault.place}: {fault.found}; expected {fault.expected}. {fault.cure}"
