"""Learn a swing: swing, evaluate, correct, swing again.

The learner chooses the next correction by the deliveries before and the response of the model.

Norm-optimal iterative learning control (Bristow, Tharayil & Alleyne 2006) on a few smooth weights. A step
minimises

    sum ((figure - target) / tolerance)^2 + mean ((path - planned path) / path scale)^2
    + effort^2 |weights|^2

as predicted, within bounds on the weights and a trust radius around the best swing so far. The prediction is
linear: the model's response is the prior mean, every swing is an observation of it. Its noise is the scatter
between swings; a swing counts less the farther its correction is from the best one's (Bayesian linear
regression). So the response becomes the robot's own, and one lucky swing is not taken for a good one. A
stopped swing counts as failed: its record up to the stop still counts for the path, and the radius is halved.
Without planned air at the address the first swing after arming begins with other air than those that follow:
it counts with more noise for the next step, and confirms nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from bench.base.errors import BenchError
from bench.base.lifecycle import CAUSE_TEXT, Cause
from bench.learning.delivery import Figures, Tolerance, delivery_from_encoders, figures_of, planned_figures
from bench.simulation.simulated_bench import Bench, Series, quiet
from bench.swing.correction import Basis, Correction, basis_of
from bench.swing.correction_terms import MAX_WEIGHT

Array = NDArray[np.float64]

PATH_SPACING = 0.005
"""Time between the instants of the downswing at which the path is compared, s."""
_STEP = 0.1
"""Step of a weight in the difference quotients."""
_AFTER = 0.03
"""Time after the planned contact for which a swing is followed, s."""


class ObservedSwing(NamedTuple):
    """A swing as the learner sees it."""

    cycles: np.ndarray[Any, Any]
    """CYCLE records of the profile's duration, from the swing's first tick."""
    figures: Figures
    """Delivery by the declared source; unknown if the swing was stopped or missed the ball."""
    cause: Cause
    settled: bool = True
    """Whether it began with the air that a swing had left, not with that of arming."""


Swinger = Callable[[Array], ObservedSwing]
"""Swings with the weights (m,) of a correction and comes back to the address, also after a stop."""


class Attempt(NamedTuple):
    """One learning swing."""

    point: Array
    """Weights of its correction."""
    figures: Figures
    """Measured figures; unknown if the swing was stopped or missed the ball."""
    path: Array
    """(r, 3) rad at the response's rows; NaN from a stop on."""
    settled: bool = True
    """Whether it began with planned air, or with that a swing had left, not with that of arming."""
    cause: Cause = Cause.NONE
    saturated: float = 0.0
    """Share of the downswing in which a valve stood at its limit."""


class Response(NamedTuple):
    """The derivatives of the model's swing by the basis' weights, without correction."""

    rows: NDArray[np.int64]
    """Samples of the downswing, up to the impact window, at which paths are compared."""
    by_figures: Array
    """(4, m) as in `Figures`."""
    by_path: Array
    """(3 r, m) rad"""
    free: Array
    """(k, 3) rad, the plant's angles tick by tick without a ball, past the contact."""


def model_response(
    bench: Bench, basis: Basis, progress: Callable[[float], None] = lambda part: None
) -> Response:
    """Return the response of `bench`'s model.

    Raises:
        BenchError: the modelled swing is stopped or misses the ball.
        Refused: the model does not reach its address.
    """
    profile, series = bench.profile, Series(bench, quiet(bench.plant))
    series.settle()
    ticks = min(round((profile.impact_time + _AFTER) / profile.period), len(profile.angle))
    rows = np.arange(profile.begins[3], profile.begins[5], round(PATH_SPACING / profile.period))

    def seen(point: Array) -> tuple[Array, Array, Cause]:
        """Swing with the correction `point` (m,); return figures, NaN without a ball, path and cause."""
        swing = series.swing_again(basis.correction(point).applied_to(profile), ticks)
        return figures_of(swing.delivery).array, swing.cycles["angle"][rows], swing.cause

    m = basis.size
    figures, path, cause = seen(np.zeros(m))
    if cause or np.isnan(figures).any():
        found = CAUSE_TEXT[cause] if cause else "the club misses the ball"
        location, wanted = f"{profile.name} on the model", "a swing that strikes the ball"
        raise BenchError(location, found, wanted, "Identify the plant, or design a new swing.")
    free = np.array(series.swing_again(profile, ticks, ball=False).cycles["plant_angle"])
    by_figures, by_path = np.zeros((4, m)), np.zeros((path.size, m))
    for i in range(m):
        sides = []
        for step in (_STEP, -_STEP):
            trial = np.zeros(m)
            trial[i] += step
            varied = seen(trial)
            if not varied[2] and np.isfinite(varied[0]).all():
                sides.append((step, *varied))
        if len(sides) < 2:
            sides.append((0.0, figures, path, cause))
        if len(sides) == 2:  # else: the weight only fails the swing and stays unused
            width = sides[0][0] - sides[1][0]
            by_figures[:, i] = (sides[0][1] - sides[1][1]) / width
            by_path[:, i] = ((sides[0][2] - sides[1][2]) / width).ravel()
        progress((i + 1) / m)
    return Response(rows, by_figures, by_path, free)


_STOPPED = 1e6
"""Added to the cost of a swing without a delivery: any swing that strikes the ball is better."""
_OFFSET = 1e4
"""Prior standard deviation of a figure without correction, tolerances: unknown."""

Four = tuple[float, float, float, float]


SWINGS = 12
"""Max number of learning swings by default."""
_PATH_SCALE = 0.01
"""Mean error of the path that counts as one tolerance of one figure (rad)."""
_EFFORT = 0.2
"""Cost of one weight."""
RADIUS, _MIN_RADIUS, _MAX_RADIUS = 1.5, 0.1, 3.0
"""Max norm of a step of the weights (trust radius): initial, smallest, largest."""
_SCATTER: Four = (0.3, 0.4, 0.2, 0.2)
"""Standard deviation between nominally equal swings in strike, speed, lean and attack, in tolerances."""
_PATH_SCATTER = 0.003
"""Standard deviation of the path (rad)."""
_UNSETTLED: Four = (1.0, 7.0, 0.7, 1.5)
"""Standard deviation by which the first swing after arming differs from the next ones, in tolerances."""
_PATH_UNSETTLED = 0.02
"""Standard deviation of the path of the first swing after arming (rad)."""
_DOUBT = 0.5
"""Share by which the robot's response differs from the model's."""
_BEND = 0.1
"""Share of the response by which a step of one weight bends it."""
ENOUGH = 0.5
"""Share of the tolerances within which every predicted figure must lie for the best swing to be repeated,
and the mean of it and its repetition for confirmation."""
_CONFIRM = 1.0
"""Share of the tolerances within which the repetition must lie."""


class Learner:
    """Proposes a `point`, notes the swing made with it, proposes the next one; the best point is kept."""

    def __init__(self, response: Response, target: Figures, plan: Array) -> None:
        """`response` is the model's, `plan` (r, 3) the planned path at its rows, rad."""
        self._target, self._scale = target.array, Tolerance().scale(target)
        self._plan = plan
        self._path_factor = 1.0 / _PATH_SCALE / np.sqrt(plan.size)
        self._prior = np.vstack(
            [response.by_figures / self._scale[:, None], self._path_factor * response.by_path]
        )
        self._noise = self._rows(_SCATTER, _PATH_SCATTER)
        self._unsettled = self._rows(_UNSETTLED, _PATH_UNSETTLED)
        self._size = np.linalg.norm(self._prior, axis=1) + 1e-9
        self._radius = RADIUS
        self.trials: list[Attempt] = []
        self._errors: list[Array] = []
        self._best = 0
        self.point = np.zeros(self._prior.shape[1])
        """Weights of the next swing."""

    def _rows(self, figures: Four, path: float) -> Array:
        return np.concatenate([figures, np.full(self._plan.size, self._path_factor * path)])

    @property
    def best(self) -> Attempt:
        """Swing with the least cost."""
        return self.trials[self._best]

    def error(self, figures: Figures) -> Array:
        """Return (figures - target) in tolerances."""
        return np.asarray((figures.array - self._target) / self._scale)

    def _alike(self, number: int) -> list[int]:
        """Return the swings with the correction of swing `number` and the same start."""
        point, settled = self.trials[number].point, self.trials[number].settled
        same = (one.settled == settled and np.array_equal(one.point, point) for one in self.trials)
        return [k for k, alike in enumerate(same) if alike]

    @property
    def confirmed(self) -> bool:
        """Whether a swing and its repetition were well within the tolerances."""
        last = len(self.trials) - 1
        repeated = len(self._alike(last)) >= 2 and self.trials[last].settled
        return repeated and self._near(self._errors[last][:4], _CONFIRM) and self._near(self._mean(last))

    @property
    def chosen(self) -> int:
        """Swing whose correction is kept: the least mean error, repeated ones preferred."""
        costs = {}
        for k in range(len(self.trials)):
            alike = self._alike(k)
            errors = np.array([self._errors[n] for n in alike])
            known = np.isfinite(errors[:, :4]).all(axis=0) & np.isfinite(errors[:, :4]).any()
            if not known.any():
                costs[k] = _STOPPED * (2.0 - float(np.isfinite(errors).mean()))
                continue
            mean = errors[:, :4].mean(axis=0)[known]
            variance = (self._noise[:4] ** 2 + self._begun(k) ** 2)[known] / len(alike)
            costs[k] = float(np.sum(mean**2) + np.sum(variance))
        return min(costs, key=lambda k: (costs[k], -k))

    @property
    def scatter(self) -> Array:
        """Standard deviation (4,) between swings alike, tolerances; the declared one without such swings."""
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
        return np.sqrt(squares / count) if count else np.array(_SCATTER)

    def note(self, trial: Attempt) -> None:
        """Note the swing made with `trial.point` and set the next `point`."""
        self.trials.append(trial)
        path = self._path_factor * (trial.path - self._plan).ravel()
        self._errors.append(np.concatenate([self.error(trial.figures), path]))
        last = len(self.trials) - 1
        if last and self._cost(last) >= self._cost(self._best):
            # An unsettled one does not judge the step.
            if trial.settled or np.isnan(trial.figures.array).all():
                self._radius = max(0.5 * self._radius, _MIN_RADIUS)
        else:
            self._best = last
            self._radius = min(1.5 * self._radius, _MAX_RADIUS) if last else self._radius
        at, matrix = self._prediction()
        near = self._near(at[:4]) and (len(self._alike(self._best)) < 2 or self._near(self._mean(self._best)))
        self.point = self.best.point if near else self._next(at, matrix)

    def _near(self, errors: Array, share: float = ENOUGH) -> bool:
        """Return whether `errors` (4,) are within `share` of the tolerances; unknown ones do not count."""
        known = errors[np.isfinite(errors)]
        return bool(known.size and np.abs(known).max() <= share)

    def _mean(self, number: int) -> Array:
        return np.asarray(np.mean([self._errors[k][:4] for k in self._alike(number)], axis=0))

    def _begun(self, number: int) -> Array:
        """Return the standard deviation (4,) of a swing's figures due to its start."""
        return np.zeros(4) if self.trials[number].settled else self._unsettled[:4]

    def _cost(self, number: int) -> float:
        errors, point = self._errors[number], self.trials[number].point
        known = np.isfinite(errors)
        missing = 0.0 if known[:4].any() else _STOPPED * float(2.0 - known.mean())
        begun = float(np.sum(self._begun(number) ** 2))
        return float(np.sum(errors[known] ** 2) + _EFFORT**2 * np.sum(point**2) + missing + begun)

    def _prediction(self) -> tuple[Array, Array]:
        """Return errors at the best point and their derivatives, NaN where still unknown."""
        start, matrix = self.best.point, self._prior.copy()
        at = np.full(len(matrix), np.nan)
        points = np.array([trial.point for trial in self.trials])
        unsettled = np.array([not trial.settled for trial in self.trials])
        errors = np.array(self._errors)
        products, distance = points @ points.T, np.sum((points - start) ** 2, axis=1)
        for k, size in enumerate(self._size):
            known = np.isfinite(errors[:, k])
            if not known.any():
                continue
            seen, spread = points[known], (_DOUBT * size) ** 2 / len(start)
            noise = self._noise[k] ** 2 + (_BEND * size * distance[known]) ** 2
            noise += unsettled[known] * self._unsettled[k] ** 2
            covariance = _OFFSET**2 + spread * products[np.ix_(known, known)] + np.diag(noise)
            weights = np.linalg.solve(covariance, errors[known, k] - seen @ self._prior[k])
            matrix[k] += spread * seen.T @ weights
            at[k] = _OFFSET**2 * weights.sum() + matrix[k] @ start
        return at, matrix

    def _next(self, errors: Array, matrix: Array) -> Array:
        start = self.best.point
        known = np.isfinite(errors)
        errors, matrix = errors[known], matrix[known]
        unit, damping = np.eye(len(start)), 0.01
        while True:
            # The damping keeps a step within the radius; unlike the effort it does not pull it towards zero.
            left = np.vstack([matrix, _EFFORT * unit, damping * unit])
            right = -np.concatenate([errors, _EFFORT * start, np.zeros(len(start))])
            step = np.asarray(lsq_linear(left, right, (-MAX_WEIGHT - start, MAX_WEIGHT - start + 1e-9)).x)
            if np.linalg.norm(step) <= self._radius:
                return start + step
            damping *= 1.6


class LearningResult(NamedTuple):
    """Result of learning."""

    problem: LearningProblem
    attempts: tuple[Attempt, ...]
    """Attempts in order; the first is the swing before learning."""
    chosen: int
    """The attempt whose correction is kept."""
    weights: Array
    """(m,) of the basis."""
    correction: Correction
    scatter: Array
    """(4,) between swings alike, tolerances; the declared scatter if no swings were alike."""

    @property
    def target(self) -> Figures:
        """The planned figures."""
        return self.problem.target

    def error(self, attempt: Attempt) -> Array:
        """Return (figures - target) of `attempt` in tolerances, (4,)."""
        return (attempt.figures.array - self.target.array) / Tolerance().scale(self.target)

    def path_error(self, attempt: Attempt) -> float:
        """Return the root mean square to the planned path up to the impact window or the stop, rad."""
        off = attempt.path - self.problem.path
        return float(np.sqrt(np.nanmean(off**2))) if np.isfinite(off).any() else float("nan")

    @property
    def within(self) -> bool:
        """Whether the kept correction's swing is within every tolerance."""
        error = self.error(self.attempts[self.chosen])
        return bool(np.nanmax(np.abs(error), initial=np.inf if np.isnan(error).all() else 0.0) <= 1.0)

    @property
    def used(self) -> int:
        """Learning swings made."""
        return len(self.attempts) - 1


class LearningProblem(NamedTuple):
    """Problem of learning: the model's response; the planned delivery and path as the target."""

    bench: Bench
    basis: Basis
    response: Response
    target: Figures
    path: Array
    """(r, 3) rad, the planned angles at the response's rows."""


def prepare(bench: Bench, progress: Callable[[float], None] = lambda part: None) -> LearningProblem:
    """Return the response of `bench`'s model; delivery and path that the profile plans are the target.

    The simulated swing is not the target: without planned chamber pressures a series starts with other
    pressures than the simulated iterations, and its delivery is up to ten tolerances off the plan.

    Raises:
        BenchError: the profile lacks its planned delivery; the modelled swing is stopped or misses the ball.
        Refused: the model does not reach its address.
    """
    target, basis = planned_figures(bench), basis_of(bench.profile)
    response = model_response(bench, basis, progress)
    return LearningProblem(bench, basis, response, target, bench.profile.angle[response.rows])


def on_series(problem: LearningProblem, series: Series) -> Swinger:
    """Return a simulated bench as a swinger; the source of the delivery is encoders and model."""
    bench, free = problem.bench, problem.response.free

    def swing(weights: Array) -> ObservedSwing:
        made = series.swing(problem.basis.correction(weights).applied_to(bench.profile))
        delivery = None if made.cause else delivery_from_encoders(made.cycles, bench.plant, free)
        return ObservedSwing(made.cycles, figures_of(delivery), made.cause, made.settled)

    return swing


def learn(
    problem: LearningProblem,
    swing: Swinger,
    swings: int = SWINGS,
    on_attempt: Callable[[Attempt], None] = lambda attempt: None,
    start: Array | None = None,
) -> LearningResult:
    """Swing until the target is reached and confirmed, at most `swings` times after the first.

    It is reached when the mean of at least two swings with the same correction lies well within every
    tolerance, and so does the last of them. The first swing has the weights `start` (m,), by default none.
    `on_attempt` is called after each swing.

    Raises:
        Refused: the robot does not come back to its address.
    """
    learner = Learner(problem.response, problem.target, problem.path)
    if start is not None:
        learner.point = start
    bench, rows = problem.bench, problem.response.rows
    for _ in range(swings + 1):
        cycles, figures, cause, settled = swing(learner.point)
        path = cycles["angle"][rows].copy()
        path[cycles["cause"][rows] != 0] = np.nan
        down = cycles[bench.profile.begins[3] : bench.profile.begins[5]]
        limited = np.abs(down["applied_valve"]).max(axis=1) >= bench.envelope.max_opening
        attempt = Attempt(learner.point, figures, path, settled, cause, float(np.mean(limited)))
        on_attempt(attempt)
        learner.note(attempt)
        if learner.confirmed:
            break
    chosen = learner.chosen
    weights = learner.trials[chosen].point
    correction = problem.basis.correction(weights)
    return LearningResult(problem, tuple(learner.trials), chosen, weights, correction, learner.scatter)
