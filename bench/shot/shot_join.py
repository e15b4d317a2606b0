"""Join of a shot's outcome and its record, which arrive in either order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bench.shot.shot_message import ShotPublication

LONGEST_WAIT = 60.0
"""s that an outcome waits for the record of its swing."""
_MOST = 64
"""Records that are remembered, and outcomes that wait."""


class ShotJoin:
    """Outcomes and records that wait for each other; time is an argument."""

    def __init__(self) -> None:
        self._records: dict[str, Mapping[str, Any]] = {}
        self._waiting: list[tuple[float, ShotPublication]] = []

    def note_record(self, shot_id: str, facts: Mapping[str, Any]) -> None:
        """Add the known keys of a shot's record."""
        self._records[shot_id] = facts
        for old in list(self._records)[:-_MOST]:
            del self._records[old]

    def note_outcome(self, message: ShotPublication, now: float) -> None:
        """Add an outcome at `now` (s)."""
        self._waiting.append((now + LONGEST_WAIT, message))

    def take(self, now: float) -> list[ShotPublication]:
        """Return the outcomes that need not or must not wait any longer, in order."""
        due, left = list[ShotPublication](), list[tuple[float, ShotPublication]]()
        for n, (last, message) in enumerate(self._waiting):
            shot = message["shot_id"]
            record = self._records.get(shot or "")
            if shot is None or record or now > last or n < len(self._waiting) - _MOST:
                due.append({**message, **(record or {})})  # type: ignore[typeddict-item]
            else:
                left.append((last, message))
        self._waiting = left
        return due
