"""A process of the bench as its supervisor sees it: started with a plan, heard by lines, ended in order."""

from __future__ import annotations

import json
import os
import pickle
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.errors import BenchError, ExitCode
from bench.processes.child_process import FOR_PARENT

_READ = 65536


class NotStarted(BenchError):
    """A process of the bench did not come up."""

    exit_code = ExitCode.DEVICE


class Child:
    """One process; `events` holds what it told and nobody has taken yet."""

    def __init__(self, name: str, process: subprocess.Popen[bytes]) -> None:
        """Adopt `process`, whose stdout is a pipe of JSON lines."""
        self.name, self.process = name, process
        self.events: list[dict[str, Any]] = []
        self._heard = b""
        if process.stdout is not None:
            os.set_blocking(process.stdout.fileno(), False)

    @classmethod
    def start(cls, name: str, module: str, plan: object, pass_fds: tuple[int, ...] = ()) -> Child:
        """Start `python -m module` with `plan` pickled on its stdin; never waits for it.

        The plan lies in memory: into a pipe a large one would go only as the child, still importing, reads.
        Signals that are not meant for the child are blocked in it from its first instruction on.
        """
        # What this process can import, its child can; more BLAS threads only disturb.
        path = os.pathsep.join(dict.fromkeys([*filter(None, sys.path), str(Path(__file__).parents[2])]))
        with open(os.memfd_create("plan"), "w+b", buffering=0) as stdin:
            stdin.write(pickle.dumps(plan))
            stdin.seek(0)
            before = signal.pthread_sigmask(signal.SIG_BLOCK, FOR_PARENT)
            try:
                process = subprocess.Popen(
                    [sys.executable, "-P", "-m", module],
                    bufsize=0,
                    stdin=stdin,
                    stdout=subprocess.PIPE,
                    pass_fds=pass_fds,
                    env={**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"},
                )
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return cls(name, process)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self.process.pid

    @property
    def alive(self) -> bool:
        """Whether it runs; a stopped one does."""
        return self.process.poll() is None

    @property
    def ending(self) -> str:
        """How it ended, in words; empty while it runs."""
        code = self.process.poll()
        if code is None:
            return ""
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"

    def listen(self) -> None:
        """Take in what it told, without waiting."""
        if self.process.stdout is None or self.process.stdout.closed:
            return
        with suppress(BlockingIOError):
            while new := os.read(self.process.stdout.fileno(), _READ):
                self._heard += new
        *lines, self._heard = self._heard.split(b"\n")
        for line in lines:
            with suppress(ValueError):
                event = json.loads(line)
                if isinstance(event, dict) and isinstance(event.get("event"), str):
                    self.events.append(event)

    def take_events(self) -> list[dict[str, Any]]:
        """Return what it told since the last call."""
        self.listen()
        taken, self.events = self.events, []
        return taken

    def wait_until_ready(self, timeout: float) -> dict[str, Any]:
        """Wait up to `timeout` (s) for its event `ready` and return it.

        Raises:
            NotStarted: it told that it failed, it ended, or its time is up.
        """
        deadline = time.monotonic() + timeout
        stdout = self.process.stdout
        while time.monotonic() < deadline:
            ended = not self.alive
            self.listen()
            while self.events:
                event = self.events.pop(0)  # what it told after it stays to be taken
                if event["event"] == "ready":
                    return event
                if event["event"] == "failed":
                    raise self._failure(event)
            if ended:
                raise NotStarted(
                    f"{self.name} process", self.ending, "it to become ready", "See what it wrote above."
                )
            select.select([stdout] if stdout else [], [], [], 0.1)
        raise NotStarted(
            f"{self.name} process",
            f"not ready after {timeout:g} s",
            "it to become ready",
            "The first start compiles for about half a minute: start again, with a cache that is kept.",
        )

    def _failure(self, event: dict[str, Any]) -> NotStarted:
        error = NotStarted(
            str(event.get("place", f"{self.name} process")),
            str(event.get("found", event.get("reason", event.get("text", "it failed")))),
            str(event.get("expected", "it to become ready")),
            str(event.get("cure", "See what it wrote above.")),
        )
        with suppress(ValueError):
            error.exit_code = ExitCode(event.get("exit_code", ExitCode.DEVICE))
        return error

    def end(self, patience: float) -> None:
        """Ask it to end, wait up to `patience` (s), then kill it; allowed when it has ended."""
        with suppress(ProcessLookupError):
            self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(patience)
        self.kill()

    def kill(self) -> None:
        """End it at once and close its pipe."""
        with suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()
        self.listen()
        if self.process.stdout is not None:
            self.process.stdout.close()
