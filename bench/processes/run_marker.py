"""What a bench remembers from one run to the next: whether it was shut down in order, and its last stop."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.errors import BenchError
from bench.telemetry.whole_file import whole_file


class RunMarker:
    """The file `state/<bench id>.json` below the data folder, written by a thread of its own.

    The disk may take longer to write than the loop allows its supervisor to be silent.
    """

    def __init__(self, data_dir: Path, bench_id: str) -> None:
        """Read what the run before this one left.

        Raises:
            BenchError: the folder cannot be made.
        """
        self.path = data_dir / "state" / f"{bench_id}.json"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BenchError(
                str(self.path.parent),
                str(error.strerror),
                "a folder that can be made",
                "Correct bench.data_dir.",
            ) from error
        before: Mapping[str, Any] = {}
        with suppress(OSError, ValueError):  # none yet, or a disk's garbage: nothing is remembered
            before = json.loads(self.path.read_text())
            before = before if isinstance(before, dict) else {}
        self.was_killed = bool(before.get("running"))
        """The run before did not end in order."""
        self.last_stop: dict[str, Any] | None = before.get("last_stop")
        """The newest stop, also of runs before."""
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
        self._ended = False
        self.trouble = ""
        """Why the file could not be written last, if it could not."""
        self._thread = threading.Thread(target=self._run, name="run marker", daemon=True)
        self._thread.start()

    def begin(self, pid: int, started_utc: str) -> None:
        """Note that this run has begun; until `end` it counts as killed."""
        self._put({"version": 1, "running": True, "pid": pid, "started_utc": started_utc})

    def note_state(self, state: str, phase: str) -> None:
        """Keep where the bench is, for the case that nobody can tell any more."""
        self._put({**self._content, "state": state, "phase": phase})

    def note_stop(self, stop: dict[str, Any], *, fatal: bool = False) -> None:
        """Keep `stop`; `fatal`: the run ends with it, and the next one is to know that."""
        self.last_stop = stop
        self._put({**self._content, **({"stopped": True} if fatal else {})})

    def end(self, *, in_order: bool) -> None:
        """Note how the run ended, and wait until that is on the disk."""
        if in_order:
            self._put({**self._content, "running": False})
        with self._changed:
            self._ended = True
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
                self._changed.wait_for(lambda: not self._written or self._ended)
                if self._written:
                    return
                content, self._written = self._content, True
            try:
                with whole_file(self.path) as stream:
                    stream.write(json.dumps(content, indent=1).encode())
                self.trouble = ""
            except BenchError as error:
                self.trouble = str(error)
