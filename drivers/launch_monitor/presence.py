"""Presence of a monitor that connects for each shot: while no ball is struck it cannot be seen."""

from __future__ import annotations

SEEN_WITHIN = 120.0
"""Time after a struck ball within which the monitor must have sent something, s: two shots of a series."""


class ShotPresence:
    """Judges by the balls that the bench struck; times in s on one clock."""

    def __init__(self) -> None:
        self._unanswered: float | None = None
        """Impact of the first ball since the monitor was last seen."""

    def note_struck(self, impact: float) -> None:
        """Note a struck ball."""
        if self._unanswered is None:
            self._unanswered = impact

    def is_present(self, seen: float | None, now: float) -> bool:
        """Return whether a monitor last `seen` at that time has not left a ball unanswered for too long."""
        if self._unanswered is not None and seen is not None and seen >= self._unanswered:
            self._unanswered = None
        return self._unanswered is None or now - self._unanswered <= SEEN_WITHIN
