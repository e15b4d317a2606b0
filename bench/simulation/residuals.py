"""How near a recorded swing came to the limits of the model-based check: wear, before it stops a swing.

The record is replayed with the observer on and without a limit that could stop it, so that a record made with
the check off shows it as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import nan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bench.control.model import KINDS
from bench.control.records import ControlState
from bench.loop import Cycles
from bench.simulation.lockstep import note_shares_of_tick
from bench.simulation.replay import replay_start, run_replay
from drivers.base import JOINTS

NEAR = 0.9
"""Share of a limit that is near it. Healthy robots reach 0.8: limits are a quarter above what those show."""
AHEAD = 200
"""Max swings ahead within which a growing residual is not to reach its limit: no more than were recorded."""
_FEW, _ENOUGH = 5, 10
"""Swings of a median, and least number of swings of a trend."""


def residual_shares(cycles: Cycles, metadata: Mapping[str, Any], place: str) -> NDArray[np.float64]:
    """Return the largest residuals of a record by comparison and joint, (5, 3), as shares of their limits.

    The limits are those that the bench used, KINDS in order; 0 where nothing was compared.

    Raises:
        BenchError, ExceptionGroup: as `bench.simulation.replay.replay_start`.
    """
    start = replay_start(cycles, metadata, place)
    limits, shares = start.parameters.model, np.zeros((len(KINDS), 3))
    watched = limits.copy()
    watched["check"] = True
    for kind in KINDS:
        watched[kind] = np.inf

    def watch(state: ControlState, tick: int, time: float) -> None:
        note_shares_of_tick(shares, limits, state, time)

    run_replay(start._replace(parameters=start.parameters._replace(model=watched)), watch)
    return shares


class Margin(NamedTuple):
    """One comparison of one joint over the swings, oldest first; shares of the limit."""

    kind: str
    joint: str
    before: float
    """Median of the first swings."""
    latest: float
    """Median of the latest swings."""
    growth: float
    """Growth per swing; NaN with too few swings, 0 if it may as well be none."""
    near: bool
    """Whether the latest are near the limit, or come there within as many swings again, `AHEAD` at most."""


def margins(shares: NDArray[np.float64]) -> list[Margin]:
    """Return the comparisons of `shares` (n, 5, 3), the largest latest ones first."""
    found = []
    for k, kind in enumerate(KINDS):
        for i, joint in enumerate(JOINTS):
            column = shares[:, k, i]
            before, latest = float(np.median(column[:_FEW])), float(np.median(column[-_FEW:]))
            growth = _growth(column)
            ahead = latest + min(AHEAD, len(column)) * growth if growth > 0.0 else latest
            found.append(Margin(kind, joint, before, latest, growth, latest >= NEAR or ahead >= 1.0))
    return sorted(found, key=lambda one: -one.latest)


def _growth(column: NDArray[np.float64]) -> float:
    """Return the slope per swing (Theil and Sen); 0 where its 95 % interval has both signs."""
    if len(column) < _ENOUGH:
        return nan
    slope = stats.theilslopes(column)
    return float(slope.slope) if slope.low_slope > 0.0 or slope.high_slope < 0.0 else 0.0
