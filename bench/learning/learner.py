"""The learner: which correction to swing next, from what the swings before delivered.

Norm-optimal iterative learning control (Bristow, Tharayil & Alleyne 2006) on a few smooth weights. A step
minimises

    sum ((figure - target) / tolerance)^2 + path_weight^2 mean ((path - planned path) / path_scale)^2
    + effort^2 |weights|^2

as predicted, within bounds on the weights and a trust radius around the best swing so far. The prediction is
linear: the model's response is the prior mean, every swing that was made is an observation of it, with the
scatter between swings as noise and less weight the farther its weights are from the best one's (Bayesian
linear regression). So the response becomes the robot's own, and one lucky swing is not taken for a good one.
A swing that was stopped counts as failed: its record up to the stop still tells of the path, and the radius
is halved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from bench.learning.correction import GREATEST_WEIGHT
from bench.learning.figures import Figures, Tolerance
from bench.learning.response import Response

Array = NDArray[np.float64]

_STOPPED = 1e6
"""Added to the cost of a swing without a delivery: any swing that strikes the ball is better."""
_OFFSET = 1e4
"""Prior standard deviation of a figure at no correction, tolerances: nothing is known of it."""

Four = tuple[float, float, float, float]


@dataclass(frozen=True)
class LearningSettings:
    """Of the learner."""

    swings: Annotated[int, Ge(1)] = 12
    """At most."""
    path_weight: Annotated[float, Ge(0)] = 1.0
    """Of a path that is `path_scale` off on average, against one tolerance of one figure."""
    path_scale: Annotated[float, Gt(0)] = 0.01
    """rad"""
    effort: Annotated[float, Ge(0)] = 0.2
    """Of one weight."""
    radius: Annotated[float, Gt(0)] = 1.5
    """Longest first step, norm of the weights."""
    greatest_radius: Annotated[float, Gt(0)] = 3.0
    least_radius: Annotated[float, Gt(0)] = 0.1
    bound: Annotated[float, Gt(0)] = GREATEST_WEIGHT
    """Of each weight."""
    scatter: Four = (0.3, 0.4, 0.2, 0.2)
    """Standard deviation between swings alike: strike, speed, lean, attack, in tolerances."""
    path_scatter: Annotated[float, Gt(0)] = 0.003
    """rad"""
    doubt: Annotated[float, Ge(0)] = 0.5
    """Share by which the robot's response differs from the model's."""
    bend: Annotated[float, Ge(0)] = 0.05
    """Share of the response by which a step of one weight bends it."""
    enough: Annotated[float, Gt(0)] = 0.5
    """Share of the tolerances within which every figure counts as reached: the swing is then repeated."""
    confirm: Annotated[float, Gt(0)] = 1.0
    """Share within which the repetition must lie; the mean of both must be near enough."""


class Trial(NamedTuple):
    """What one swing told."""

    point: Array
    """Weights it was swung with."""
    figures: Array
    """(4,), NaN where they are not known or the swing was stopped."""
    path: Array
    """(r, 3) rad at the response's rows; NaN from a stop on."""


class Learner:
    """Asked for a point, told of the swing made with it, and so on; the best point is kept."""

    def __init__(self, response: Response, target: Figures, tolerance: Tolerance, settings: LearningSettings):
        """`response` is the model's without correction."""
        s, self._settings = settings, settings
        self._target, self._scale = target.array, tolerance.scale(target)
        self._plan = response.path
        self._path_factor = s.path_weight / s.path_scale / np.sqrt(response.path.size)
        self._prior = np.vstack(
            [response.by_figures / self._scale[:, None], self._path_factor * response.by_path]
        )
        self._noise = np.concatenate(
            [s.scatter, np.full(response.path.size, self._path_factor * s.path_scatter)]
        )
        self._size = np.linalg.norm(self._prior, axis=1) + 1e-9
        self._radius = s.radius
        self.point = np.zeros(self._prior.shape[1])
        """The weights to swing next."""
        self.trials: list[Trial] = []
        self._errors: list[Array] = []
        self._best = 0

    @property
    def best(self) -> Trial:
        """The swing that came nearest, all in all."""
        return self.trials[self._best]

    def error(self, figures: Array) -> Array:
        """Return (figures - target) in tolerances."""
        return np.asarray((figures - self._target) / self._scale)

    def _reached(self, number: int, share: float) -> bool:
        """Whether a swing is within `share` of every tolerance; a figure not measured is not asked."""
        figures = self.trials[number].figures
        known = self.error(figures)[~np.isnan(figures)]
        return bool(known.size and np.max(np.abs(known)) <= share)

    def _alike(self, number: int) -> list[int]:
        """Return the swings made with the correction of swing `number`."""
        point = self.trials[number].point
        return [k for k, trial in enumerate(self.trials) if np.array_equal(trial.point, point)]

    @property
    def confirmed(self) -> bool:
        """Whether a swing that was well within the tolerances was repeated, and so was the repetition."""
        last = len(self.trials) - 1
        alike = self._alike(last)
        if len(alike) < 2 or not self._reached(last, self._settings.confirm):
            return False
        mean = np.array([self.error(self.trials[k].figures) for k in alike]).mean(axis=0)
        return bool(np.nanmax(np.abs(mean)) <= self._settings.enough)

    @property
    def chosen(self) -> int:
        """The swing whose correction is to be kept: least mean error, repeated ones preferred."""
        costs = {}
        for k in range(len(self.trials)):
            alike = self._alike(k)
            errors = np.array([self._errors[n] for n in alike])
            known = np.isfinite(errors[:, :4]).all(axis=0) & np.isfinite(errors[:, :4]).any()
            if not known.any():
                costs[k] = _STOPPED * (2.0 - float(np.isfinite(errors).mean()))
                continue
            mean = errors[:, :4].mean(axis=0)[known]
            noise = np.array(self._settings.scatter)[known] / np.sqrt(len(alike))
            costs[k] = float(np.sum(mean**2) + np.sum(noise**2))
        return min(costs, key=lambda k: (costs[k], -k))

    @property
    def scatter(self) -> Array:
        """Standard deviation (4,) between swings alike, tolerances; the declared one without two alike."""
        squares, count = np.zeros(4), 0
        for first in range(len(self.trials)):
            alike = self._alike(first)
            if alike[0] != first or len(alike) < 2:
                continue
            errors = np.array([self.error(self.trials[k].figures) for k in alike])
            errors = errors[np.isfinite(errors).all(axis=1)]
            if len(errors) > 1:
                squares += np.sum((errors - errors.mean(axis=0)) ** 2, axis=0)
                count += len(errors) - 1
        return np.sqrt(squares / count) if count else np.array(self._settings.scatter)

    def note(self, trial: Trial) -> None:
        """Take note of the swing made with `trial.point` and set the next `point`."""
        path = self._path_factor * (trial.path - self._plan)
        self.trials.append(trial)
        self._errors.append(np.concatenate([self.error(trial.figures), path.ravel()]))
        last, s = len(self.trials) - 1, self._settings
        if last and self._cost(last) >= self._cost(self._best):
            self._radius = max(0.5 * self._radius, s.least_radius)
        else:
            self._best = last
            self._radius = min(1.5 * self._radius, s.greatest_radius) if last else self._radius
        again = self._reached(last, s.enough) and len(self._alike(last)) == 1
        self.point = trial.point if again else self._next()

    def _cost(self, number: int) -> float:
        errors, point = self._errors[number], self.trials[number].point
        known = np.isfinite(errors)
        missing = 0.0 if known[:4].any() else _STOPPED * float(2.0 - known.mean())
        return float(np.sum(errors[known] ** 2) + self._settings.effort**2 * np.sum(point**2) + missing)

    def _prediction(self) -> tuple[Array, Array]:
        """Return errors at the best point and their derivatives, NaN where nothing is known yet."""
        s, start = self._settings, self.best.point
        points = np.array([trial.point for trial in self.trials]) - start
        errors = np.array(self._errors)
        products, distance = points @ points.T, np.sum(points**2, axis=1)
        at, matrix = np.full(len(self._noise), np.nan), self._prior.copy()
        for k, size in enumerate(self._size):
            known = np.isfinite(errors[:, k])
            if not known.any():
                continue
            spread = (s.doubt * size) ** 2 / len(start)
            noise = self._noise[k] ** 2 + (s.bend * size * distance[known]) ** 2
            covariance = _OFFSET**2 + spread * products[np.ix_(known, known)] + np.diag(noise)
            surprise = errors[known, k] - points[known] @ self._prior[k]
            weights = np.linalg.solve(covariance, surprise)
            at[k] = _OFFSET**2 * weights.sum()
            matrix[k] += spread * points[known].T @ weights
        return at, matrix

    def _next(self) -> Array:
        s, start = self._settings, self.best.point
        errors, matrix = self._prediction()
        known = np.isfinite(errors)
        errors, matrix = errors[known], matrix[known]
        unit, damping = np.eye(len(start)), 0.01
        while True:
            # The damping keeps a step within the radius; unlike the effort it does not pull it towards zero.
            left = np.vstack([matrix, s.effort * unit, damping * unit])
            right = -np.concatenate([errors, s.effort * start, np.zeros(len(start))])
            step = np.asarray(lsq_linear(left, right, (-s.bound - start, s.bound - start + 1e-9)).x)
            if np.linalg.norm(step) <= self._radius:
                return start + step
            damping *= 1.6
