"""How badly a model fits a recorded swing, beyond what its values may be off by their standard errors."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from bench.commissioning.known_robot import FoundValue
from bench.commissioning.machine import Array
from bench.commissioning.short_predictions import QUANTITIES, RecordedSwing
from bench.control.measured_plant import value_at, with_values
from sim.plant import PlantParameters

_SCATTER = np.array([5e-4] * 3 + [0.05] * 3 + [300.0] * 6 + [100.0])
"""Errors of predictions over a window that count as one: rad, rad/s, Pa."""
_OUTLIER = 5.0
"""Error from which it counts less: a joint that breaks loose a little later is no other robot."""
_ROUNDS = 4
_NEAR = 2.0
"""Standard errors by which values may move for their effects to be taken there."""
_BETTER = 0.5
"""Share of the misfit that has to be left for their effects to be taken there."""
_STEP = 0.3
"""Step of a derivative, in standard errors."""
_GUESSES = {
    "robot.l12": 1e-3,
    "robot.l16": 1e-3,
    "robot.l23": 1e-3,
    "robot.l56": 1e-3,
    "wrist_lever": 1e-3,
}
"""Standard errors of values that no step measures, m."""


class UncertainValue(NamedTuple):
    """A value of the plant with its standard error."""

    key: str
    value: float
    error: float


def uncertain_values(found: Iterable[FoundValue], plant: PlantParameters) -> list[UncertainValue]:
    """Return the values of `plant` with a standard error as `found`; the last of a key counts."""
    errors = {one.key: one.error for one in found}
    errors = {key: error for key, error in (_GUESSES | errors).items() if error > 0.0}
    return [UncertainValue(key, float(value_at(plant, key)), error) for key, error in errors.items()]


class Misfit(NamedTuple):
    """What stays unexplained of a swing."""

    cost: float
    """Mean of the squared errors of windows, in units of their scatter; large ones count less."""
    errors: Array
    """(k, QUANTITIES) what stays."""
    shift: Array
    """(p,) standard errors by which the uncertain values would be others than in the model."""


def swing_misfit(
    recorded: RecordedSwing, plant: PlantParameters, uncertain: list[UncertainValue]
) -> SwingMisfit:
    """Return the misfit of `recorded` around `plant`, or around likelier values where these explain it.

    Effects are not linear: once more there, but not where values only bend towards what a cause does.
    """
    measured = SwingMisfit(recorded, plant, uncertain, np.zeros(len(uncertain)))
    moved = np.clip(measured.none.shift, -_NEAR, _NEAR)
    moves = zip(uncertain, moved.tolist(), strict=True)
    nearer = with_values(plant, {one.key: one.value + by * one.error for one, by in moves})
    likelier = SwingMisfit(recorded, nearer, uncertain, moved)
    return measured if likelier.none.cost > _BETTER * measured.none.cost else likelier


class SwingMisfit:
    """Misfit of a recorded swing, with the effects of the uncertain values around a plant."""

    def __init__(
        self, recorded: RecordedSwing, plant: PlantParameters, uncertain: list[UncertainValue], moved: Array
    ) -> None:
        """Take how `uncertain` values act on the windows, `moved` (p,) standard errors in `plant`."""
        self.recorded, self.plant, self._moved = recorded, plant, moved
        self.base = recorded.errors(plant)
        self.effects = np.stack([effect(recorded, plant, self.base, one) for one in uncertain], axis=-1)
        """(k, QUANTITIES, p) by standard error."""
        self.none = self.of(self.base)
        """Without a cause."""

    def since(self, errors: Array) -> tuple[int, Misfit]:
        """Return the first window in which the model with `errors` is the better one, and the misfit.

        Before it the errors are those without a cause: windows do not depend on each other.
        """
        effect = np.einsum("kqi,i->kq", self.effects, self.none.shift)
        # What the values explain without a cause may be what the cause does.
        firsts = {0, _better_from(self.base, errors), _better_from(self.base - effect, errors - effect)}
        found = [(first, self.of(np.concatenate([self.base[:first], errors[first:]]))) for first in firsts]
        return min(found, key=lambda one: one[1].cost)

    def of(self, errors: Array) -> Misfit:
        """Return what stays of `errors` (k, QUANTITIES) with the best values."""
        wanted = (errors / _SCATTER).ravel()
        design = (self.effects / _SCATTER[:, None]).reshape(len(wanted), -1)
        shift, weight = np.zeros(design.shape[1]), np.ones(len(wanted))
        left = wanted
        for _ in range(_ROUNDS):
            # No threads of a linear algebra library: they wait for each other where others have processors.
            weighted = design * weight[:, None]
            normal = np.einsum("ni,nj->ij", weighted, design) + np.eye(design.shape[1])
            shift = np.linalg.solve(normal, np.einsum("ni,n->i", weighted, wanted) - self._moved)
            left = wanted - np.einsum("ni,i->n", design, shift)
            weight = 1.0 / np.sqrt(1.0 + (left / _OUTLIER) ** 2)
        cost = (float(_robust(left).sum()) + float(np.sum((self._moved + shift) ** 2))) / max(len(wanted), 1)
        return Misfit(cost, left.reshape(-1, QUANTITIES) * _SCATTER, shift)


def _better_from(without: Array, within: Array) -> int:
    """Return the window from which on errors `within` (k, QUANTITIES) are smaller than those `without`."""
    gain = [_robust(errors / _SCATTER).sum(axis=1) for errors in (without, within)]
    return int(np.argmax(np.append(np.cumsum((gain[0] - gain[1])[::-1])[::-1], 0.0)))


def _robust(errors: Array) -> Array:
    """Return the squares of `errors`, linear far beyond the scatter."""
    return np.asarray(2.0 * _OUTLIER**2 * (np.sqrt(1.0 + (errors / _OUTLIER) ** 2) - 1.0))


def effect(recorded: RecordedSwing, plant: PlantParameters, base: Array, one: UncertainValue) -> Array:
    """Return what a standard error of `one` adds to the model's predictions (k, QUANTITIES)."""
    step = _STEP * one.error
    moved = recorded.errors(with_values(plant, {one.key: float(value_at(plant, one.key)) + step}))
    return np.asarray((base - moved) / _STEP)
