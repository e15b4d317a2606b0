"""Learn a swing: swing, evaluate, correct, swing again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.lifecycle import Cause
from bench.learning.delivery import Figures, delivery_from_encoders, figures_of, planned_figures
from bench.learning.ilc import SWINGS, Learner, LearnerTrial, Response, model_response
from bench.simulation.series import Bench, Series
from bench.swing.correction import Basis, Correction, basis_of

Array = NDArray[np.float64]


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

    figures: Figures
    """Measured figures; unknown if the swing was stopped or missed the ball."""
    error: Array
    """(4,) in tolerances."""
    path_error: float
    """Root mean square to the planned path up to the impact window or the stop, rad."""
    cause: Cause
    saturated: float
    """Share of the downswing in which a valve stood at its limit."""
    effort: float
    """Norm of the correction's weights."""


class LearningResult(NamedTuple):
    """Result of learning."""

    target: Figures
    attempts: tuple[Attempt, ...]
    """The first is the swing before learning."""
    chosen: int
    """The attempt whose correction is kept."""
    weights: Array
    """(m,) of the basis."""
    correction: Correction
    scatter: Array
    """(4,) between swings alike, tolerances; the declared scatter if no swings were alike."""

    @property
    def within(self) -> bool:
        """Whether the kept correction's swing is within every tolerance."""
        error = self.attempts[self.chosen].error
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

    Those of the model's swing are not. Without planned chamber pressures a series begins with other pressures
    than the simulated iterations, and delivers up to ten tolerances off the plan.

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
        delivery = None if made.cause else delivery_from_encoders(made.cycles, bench.model, free)
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
    attempts: list[Attempt] = []
    for _ in range(swings + 1):
        trial, attempt = _attempt(problem, swing, learner)
        attempts.append(attempt)
        on_attempt(attempt)
        learner.note(trial)
        if learner.confirmed:
            break
    chosen = learner.chosen
    weights = learner.trials[chosen].point
    return LearningResult(
        problem.target, tuple(attempts), chosen, weights, problem.basis.correction(weights), learner.scatter
    )


def _attempt(problem: LearningProblem, swing: Swinger, learner: Learner) -> tuple[LearnerTrial, Attempt]:
    bench, response, point = problem.bench, problem.response, learner.point
    cycles, figures, cause, settled = swing(point)
    path = cycles["angle"][response.rows].copy()
    path[cycles["cause"][response.rows] != 0] = np.nan
    trial = LearnerTrial(point, figures.array, path, settled)
    down = cycles[bench.profile.begins[3] : bench.profile.begins[5]]
    off = path - problem.path
    attempt = Attempt(
        figures,
        learner.error(trial.figures),
        float(np.sqrt(np.nanmean(off**2))) if np.isfinite(off).any() else float("nan"),
        cause,
        float(np.mean(np.abs(down["applied_valve"]).max(axis=1) >= bench.envelope.max_opening)),
        float(np.linalg.norm(point)),
    )
    return trial, attempt
