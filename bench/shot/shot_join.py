"""Join of a shot's outcome and its record, which arrive in either order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

LONGEST_WAIT = 60.0
"""s that an outcome waits for the record of its swing."""
_MOST = 64
"""Records that are remembered, and outcomes that wait."""


class ShotJoin:
    """Outcomes and records that wait for each other; time is an argument."""

    def __init__(self) -> None:
        self._records: dict[str, str] = {}
        self._waiting: list[tuple[float, dict[str, Any]]] = []

    def note_record(self, shot_id: str, path: str) -> None:
        """Add the path of a shot's record."""
        self._records[shot_id] = path
        for old in list(self._records)[:-_MOST]:
            del self._records[old]

    def note_outcome(self, message: Mapping[str, Any], now: float) -> None:
        """Add an outcome as `bench.shot.shot_message` describes it, at `now` (s)."""
        self._waiting.append((now + LONGEST_WAIT, dict(message)))

    def take(self, now: float) -> list[dict[str, Any]]:
        """Return the outcomes that need not or must not wait any longer, in order."""
        due, left = list[dict[str, Any]](), list[tuple[float, dict[str, Any]]]()
        for n, (last, message) in enumerate(self._waiting):
            shot = message["shot_id"]
            record = None if shot is None else self._records.get(shot)
            if shot is None or record or now > last or n < len(self._waiting) - _MOST:
                due.append({**message, "record": record})
            else:
                left.append((last, message))
        self._waiting = left
        return due
