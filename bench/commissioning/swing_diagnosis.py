"""Which cause explains that a robot swung otherwise than the one that was measured?

Every cause is fitted to the recorded swing, with all measured values free within their standard errors. The
one that leaves least is named if it leaves much less than any other and than none.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from bench.commissioning.known_robot import FoundValue
from bench.commissioning.machine import Array
from bench.commissioning.short_predictions import PRESSURE, SPEED, Cycles, RecordedSwing
from bench.commissioning.swing_causes import SwingCause, swing_causes
from bench.commissioning.swing_misfit import SwingMisfit, swing_misfit, uncertain_values
from drivers.base import JOINTS
from sim.plant import PlantParameters

CLEARLY = 1.5
"""Times by which the misfit without a cause, and with the next best one, has to exceed the named one's."""
_USUAL = 0.5
"""Misfit up to which no cause is looked for, and which is added to all in ratios; right robots had less."""
_FINE = 10
"""Max trials of a value between those that the search begins with."""
_REFINED = 8
"""Causes whose value is searched finely: the best ones of the coarse search."""


class FittedCause(NamedTuple):
    """A cause with the value that explains most."""

    cause: SwingCause
    value: float
    since: float
    """s of the record from which it acts."""
    misfit: float


class Diagnosis(NamedTuple):
    """What a recorded swing says of the robot."""

    named: FittedCause | None
    """The cause that explains it clearly; None if none does."""
    fitted: tuple[FittedCause, ...]
    """The best of each place and kind, best first; none where the measured model fits."""
    misfit: float
    """Without a cause, measured values free within their errors."""
    speed: Array
    """(3,) scatter of the joints' speeds beside predictions over a window, rad/s."""
    pressure: Array
    """(3,) scatter of their chambers' pressures, Pa."""
    ratio: float
    """Misfit of the next best over that of the best."""

    @property
    def text(self) -> str:
        """What it says, for a person."""
        joints = ", ".join(
            f"{joint} {speed:.2f} rad/s and {1e-2 * pressure:.0f} mbar"
            for joint, speed, pressure in zip(
                JOINTS, self.speed.tolist(), self.pressure.tolist(), strict=True
            )
        )
        scatter = f"scatter beside short predictions: {joints}"
        if not self.fitted:
            return f"over short times the robot moves as measured (misfit {self.misfit:.2g}; {scatter})"
        best, second = self.fitted[:2]
        left = f"misfit {self.misfit:.3g} without a cause, {best.misfit:.3g} with"
        if self.named is not None:
            other = f"{second.cause.place}: {second.cause.what}"
            return f"{_named(best)}; {left} it; {self.ratio:.1f} times as much with the next best, {other}"
        return (
            f"its record does not say clearly why: {left} {_named(best)}; {self.ratio:.1f} times as much "
            f"with {_named(second)}; {scatter}"
        )


def _named(one: FittedCause) -> str:
    since = f"from {one.since:.2f} s of the swing on"
    return f"{one.cause.place}: {one.cause.what} ({one.cause.words(one.value)}, {since})"


def diagnose(cycles: Cycles, plant: PlantParameters, found: Iterable[FoundValue]) -> Diagnosis:
    """Return what CYCLE records of a swing say of the robot measured as `plant`, with its values `found`."""
    recorded = RecordedSwing(cycles, plant)
    misfit = swing_misfit(recorded, plant, uncertain_values(found, plant))
    none = misfit.none
    pairs = none.errors[:, PRESSURE].reshape(-1, 3, 2)
    scatter = _scatter(none.errors[:, SPEED], 0), _scatter(pairs, (0, 2))
    if not none.cost > _USUAL:
        return Diagnosis(None, (), none.cost, *scatter, 1.0)
    coarse = sorted((_coarse(cause, misfit) for cause in swing_causes(recorded)), key=_misfit_of)
    fitted = sorted([*(_fine(one, misfit) for one in coarse[:_REFINED]), *coarse[_REFINED:]], key=_misfit_of)
    best = dict[tuple[str, str], FittedCause]()
    for one in fitted:
        best.setdefault((one.cause.place, one.cause.what), one)
    ranked = list(best.values())
    least = ranked[0].misfit + _USUAL
    ratio = (ranked[1].misfit + _USUAL) / least
    clear = ratio >= CLEARLY and (none.cost + _USUAL) / least >= CLEARLY
    return Diagnosis(ranked[0] if clear else None, tuple(ranked), none.cost, *scatter, ratio)


def _scatter(errors: Array, axes: int | tuple[int, int]) -> Array:
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=axes)))


def _misfit_of(one: FittedCause) -> float:
    return one.misfit


def _coarse(cause: SwingCause, misfit: SwingMisfit) -> FittedCause:
    """Return `cause` with the best of the values that the search begins with."""
    return min((_tried(cause, value, misfit) for value in cause.values), key=_misfit_of)


def _fine(coarse: FittedCause, misfit: SwingMisfit) -> FittedCause:
    """Return the cause with the best value near that of the `coarse` search."""
    cause = coarse.cause
    at, tried = cause.values.index(coarse.value), [coarse]
    bounds = cause.values[max(at - 1, 0)], cause.values[min(at + 1, len(cause.values) - 1)]

    def left(value: float) -> float:
        tried.append(_tried(cause, value, misfit))
        return tried[-1].misfit

    minimize_scalar(left, bounds=bounds, method="bounded", options={"maxiter": _FINE})
    return min(tried, key=_misfit_of)


def _tried(cause: SwingCause, value: float, misfit: SwingMisfit) -> FittedCause:
    first, found = misfit.since(cause.errors(misfit.recorded, misfit.plant, value))
    starts = misfit.recorded.starts()
    begin = starts[min(first, len(starts) - 1)] * misfit.recorded.tick
    return FittedCause(cause, value, float(begin), found.cost)
