"""State kept between two runs of a bench: whether the shutdown was clean, and the last stop."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.base.atomic_file import atomic_file
from bench.base.errors import BenchError


class RunMarker:
    """The file `state/<bench id>.json` in the data folder, written by a separate thread.

    A disk write may take longer than the supervisor's heartbeat time-out.
    """

    def __init__(self, data_dir: Path, bench_id: str) -> None:
        """Read the state of the previous run.

        Raises:
            BenchError: the folder cannot be created.
        """
        self.path = data_dir / "state" / f"{bench_id}.json"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BenchError(
                str(self.path.parent),
                str(error.strerror),
                "a folder that can be created",
                "Set bench.data_dir to a folder with write access.",
            ) from error
        before: Mapping[str, Any] = {}
        with suppress(OSError, ValueError):  # missing or corrupt: start without state
            before = json.loads(self.path.read_text(encoding="utf-8"))
            before = before if isinstance(before, dict) else {}
        self.was_killed = bool(before.get("running"))
        """Whether the previous shutdown was unclean."""
        self.last_stop: dict[str, Any] | None = before.get("last_stop")
        """Last stop, also of previous runs."""
        if self.was_killed and not before.get("stopped"):
            self.last_stop = {
                "cause": "RESTART",
                "text": "the supervisor was killed, or the machine lost power",
                "state": before.get("state", ""),
                "phase": before.get("phase", ""),
                "run_started_utc": before.get("started_utc"),
            }
        self._content: dict[str, Any] = {}
        self._changed = threading.Condition()
        self._written = True
        self._finished = False
        self.fault = ""
        """Why the last write failed; empty if it succeeded."""
        self._thread = threading.Thread(target=self._run, name="run marker", daemon=True)
        self._thread.start()

    def begin(self, pid: int, started_utc: str) -> None:
        """Mark this run as started; until `end` it counts as killed."""
        self._put({"version": 1, "running": True, "pid": pid, "started_utc": started_utc})

    def note_state(self, state: str, phase: str) -> None:
        """Store state and phase, for a later report on a killed run."""
        self._put({**self._content, "state": state, "phase": phase})

    def note_stop(self, stop: dict[str, Any], *, fatal: bool = False) -> None:
        """Store `stop`; `fatal` marks that the run ends with it."""
        self.last_stop = stop
        self._put({**self._content, **({"stopped": True} if fatal else {})})

    def end(self, *, clean: bool) -> None:
        """Store whether the shutdown was clean, and wait until it is written."""
        if clean:
            self._put({**self._content, "running": False})
        with self._changed:
            self._finished = True
            self._changed.notify()
        self._thread.join()

    def _put(self, content: dict[str, Any]) -> None:
        with self._changed:
            self._content = {**content, "last_stop": self.last_stop}
            self._written = False
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: not self._written or self._finished)
                if self._written:
                    return
                content, self._written = self._content, True
            try:
                with atomic_file(self.path) as stream:
                    stream.write(json.dumps(content, indent=1).encode())
                self.fault = ""
            except BenchError as error:
                self.fault = str(error)
