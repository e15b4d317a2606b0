"""Swings found in the ring: each with its id, its cycles and the instant of its impact."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from bench.lifecycle import Phase, State
from bench.shot.ball_struck import ball_struck
from bench.telemetry.shot_id import shot_id

Cycles = np.ndarray[Any, Any]

_LONGEST = 30_000
"""Cycles that are kept of a swing."""
_AT_THE_BALL = (Phase.COMMITTED, Phase.IMPACT, Phase.FOLLOW_THROUGH)


class FinishedSwing(NamedTuple):
    """A swing that is over."""

    shot: str
    """Its id."""
    impact: float | None
    """s, CLOCK_MONOTONIC, when the head came to the ball's place; None when it did not."""
    struck: bool
    """A ball lay on the tee until then."""
    cycles: Cycles
    """Of the swing, and the one after it."""


class SwingWatch:
    """Follows the state of the bench; for one run of its loop."""

    def __init__(self, run: str, *, wall: bool) -> None:
        """`run` is its id; `wall`: the loop's time is CLOCK_MONOTONIC, otherwise virtual."""
        self._run, self._wall = run, wall
        self._state = State.SWINGING
        """Of the cycle before; a swing under way at the start has no beginning, and so no id."""
        self._parts: list[Cycles] | None = None
        self._behind: list[float] = []
        """CLOCK_MONOTONIC less loop's time, s, of each part: a loop in step with a plant slips."""

    def take(self, cycles: Cycles, now: float, *, lost: bool = False) -> list[FinishedSwing]:
        """Take new `cycles` read at `now` (s, CLOCK_MONOTONIC); return the swings that ended in them.

        They are kept as they are, not copied. `lost`: the ring has
        lost cycles before these, and with them the swing under way.
        """
        if lost:
            self._state, self._parts = State.SWINGING, None
        ended: list[FinishedSwing] = []
        if not len(cycles):
            return ended
        swinging = cycles["state"] == State.SWINGING
        before = np.concatenate([[self._state == State.SWINGING], swinging[:-1]])
        edges = [0, *np.flatnonzero(swinging != before).tolist(), len(cycles)]
        behind = 0.0 if self._wall else now - float(cycles["time"][-1])
        for first, last in pairwise(edges):
            if first == last:
                continue
            if not swinging[first]:
                if self._parts is not None:  # the cycle that ended it gives the reason
                    self._parts.append(cycles[first : first + 1])
                    self._behind.append(behind)
                    ended.append(self._end(self._parts))
                continue
            if not before[first]:
                self._parts, self._behind = [], []
            if self._parts is not None:
                self._parts.append(cycles[first:last])
                self._behind.append(behind)
                if sum(map(len, self._parts)) > _LONGEST:
                    self._parts = None
        self._state = State(int(cycles["state"][-1]))
        return ended

    def _end(self, parts: list[Cycles]) -> FinishedSwing:
        """Return the swing of `parts`, which is over."""
        # As bytes: numpy joins records field by field.
        whole = np.concatenate([part.view(np.uint8) for part in parts]).view(parts[0].dtype)
        behind = np.repeat(self._behind, [len(part) for part in parts])
        self._parts = None
        at = _impact(whole)
        impact = None if at is None else float(whole["time"][at] + behind[at])
        return FinishedSwing(shot_id(self._run, int(whole["tick"][0])), impact, ball_struck(whole), whole)


def _impact(cycles: Cycles) -> int | None:
    """Return the first cycle after the impact: the ball is gone, or its window has begun."""
    at_the_ball = np.isin(cycles["phase"], _AT_THE_BALL)
    there = cycles["ball_present"].astype(bool)
    gone = np.flatnonzero(at_the_ball[1:] & there[:-1] & ~there[1:])
    if len(gone):
        return int(gone[0]) + 1
    passed = np.flatnonzero(np.isin(cycles["phase"], (Phase.IMPACT, Phase.FOLLOW_THROUGH)))
    return int(passed[0]) if len(passed) else None
