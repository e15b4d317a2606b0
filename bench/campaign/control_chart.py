"""Control chart of the control ball: individual values in order, judged by Nelson's eight rules.

The limits come from the moving range of the same series (Shewhart's chart for individuals, ISO 7870-2), so
that a slow drift does not widen them. The control ball is the same throughout: a signal is of the robot, the
monitor or the air, never of the compared balls.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.campaign.analysis import COLUMN
from bench.campaign.block_model import Array
from bench.campaign.plan import CampaignPlan
from bench.campaign.randomization import Role
from bench.shot.shot import Shot, ShotStatus

_MEAN_RANGE = 1.128379167
"""Mean range of two normal values over their standard deviation."""
LEAST_VALUES = 8
"""Min number of values for limits."""

NELSON: Mapping[int, str] = {
    1: "one value beyond three standard deviations",
    2: "nine in a row on one side of the mean",
    3: "six in a row rising, or falling",
    4: "fourteen in a row up and down in turn",
    5: "two of three beyond two standard deviations on one side",
    6: "four of five beyond one standard deviation on one side",
    7: "fifteen in a row within one standard deviation",
    8: "eight in a row beyond one standard deviation, on both sides",
}
"""The rules, by number (Nelson 1984)."""


@dataclass(frozen=True)
class NelsonSignal:
    """Shots at which a rule was met."""

    rule: int
    shots: tuple[int, ...]
    """The last shot of each pattern."""


@dataclass(frozen=True)
class ControlChart:
    """The control ball in one quantity."""

    column: str
    shots: tuple[int, ...]
    values: tuple[float, ...]
    centre: float
    deviation: float
    """Standard deviation by the moving range."""
    signals: tuple[NelsonSignal, ...]


def control_charts(plan: CampaignPlan, shots: Sequence[Shot]) -> tuple[ControlChart, ...]:
    """Return a section's charts: of the compared quantity and of the ball speed, which sets the machine.

    Empty without a control ball, or with fewer than `LEAST_VALUES` of its values.
    """
    controls = [shot for shot in shots if shot.role == Role.CONTROL and shot.status is ShotStatus.VALID]
    column = COLUMN.get(plan.analysis.quantity, plan.analysis.quantity)
    charts = (_chart(name, controls) for name in dict.fromkeys((column, "ball_speed_mps")))
    return tuple(chart for chart in charts if chart is not None)


def _chart(column: str, controls: Sequence[Shot]) -> ControlChart | None:
    measured = [(shot.shot, value) for shot in controls if (value := getattr(shot, column)) is not None]
    if len(measured) < LEAST_VALUES:
        return None
    values = np.array([value for _, value in measured], dtype=float)
    centre, deviation = float(values.mean()), float(np.abs(np.diff(values)).mean()) / _MEAN_RANGE
    signals = []
    if deviation > 0:
        for rule, places in nelson_signals((values - centre) / deviation).items():
            signals.append(NelsonSignal(rule, tuple(measured[place][0] for place in places)))
    return ControlChart(
        column,
        tuple(shot for shot, _ in measured),
        tuple(map(float, values)),
        centre,
        deviation,
        tuple(signals),
    )


def nelson_signals(z: Array) -> dict[int, list[int]]:
    """Return the places in `z` (n,), in standard deviations from the mean, that end each rule's pattern."""
    up, steps = z > 0, np.sign(np.diff(z))
    turns = np.concatenate([[False], steps[1:] * steps[:-1] < 0])
    found: dict[int, NDArray[np.bool_]] = {
        1: np.abs(z) > 3,
        2: _either(z, lambda side: _run(side > 0, 9)),
        3: _after_steps(steps > 0, 5) | _after_steps(steps < 0, 5),
        4: _after_steps(turns, 12),
        5: _either(z, lambda side: _of(side > 2, 2, 3)),
        6: _either(z, lambda side: _of(side > 1, 4, 5)),
        7: _run(np.abs(z) < 1, 15),
        8: _run(np.abs(z) > 1, 8) & ~_run(up, 8) & ~_run(~up, 8),
    }
    return {
        rule: places for rule, hits in found.items() if (places := [int(p) for p in np.flatnonzero(hits)])
    }


def _either(z: Array, rule: Callable[[Array], NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Return where `rule` holds on the upper or on the lower side."""
    return rule(z) | rule(-z)


def _of(hits: NDArray[np.bool_], wanted: int, window: int) -> NDArray[np.bool_]:
    """Return where a hit is the last of `wanted` among `window` values."""
    total = np.concatenate([np.zeros(window, int), np.cumsum(hits)])
    return np.asarray(hits & (total[window:] - total[:-window] >= wanted))


def _run(hits: NDArray[np.bool_], length: int) -> NDArray[np.bool_]:
    """Return where `length` hits in a row end."""
    return _of(hits, length, length)


def _after_steps(hits: NDArray[np.bool_], length: int) -> NDArray[np.bool_]:
    """Return the values after `length` hits in a row among the steps between values."""
    return np.concatenate([[False], _run(hits, length)])
