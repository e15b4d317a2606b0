"""Learn a swing: swing, evaluate, correct, swing again; also from swings of an identified robot.

An identified robot swings nearly as the recorded one did. The remaining difference in delivery, by the same
measuring chain, is known from the recorded swings. It changes little from one correction to the next. So the
identified robot learns a target that is lower by it. The first swing of the robot itself has neither the
model's error nor the identification's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import BenchError
from bench.base.lifecycle import Cause, Phase
from bench.learning.delivery import Figures, Tolerance, delivery_from_encoders, figures_of, planned_figures
from bench.learning.ilc import DOUBT, RADIUS, SWINGS, Beginning, Learner, LearnerTrial, Model, Response
from bench.records.shot.recorded_shot import plant_of
from bench.records.telemetry.recorder import read_swing
from bench.records.telemetry.swing_metadata import read_profile
from bench.simulation.series import Bench, Series, quiet
from bench.swing.correction import Basis, Correction, basis_of, digest_of
from bench.swing.profile import Profile
from sim.plant import Encoders, PlantParameters

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
    beginning: Beginning | None = None
    """First correction on an identified robot; None: without correction."""


def prepare(bench: Bench, progress: Callable[[float], None] = lambda part: None) -> LearningProblem:
    """Return the response of `bench`'s model; delivery and path that the profile plans are the target.

    Those of the model's swing are not. Without planned chamber pressures a series begins with other pressures
    than the simulated iterations, and delivers up to ten tolerances off the plan.

    Raises:
        BenchError: the profile lacks its planned delivery; the modelled swing is stopped or misses the ball.
        Refused: the model does not reach its address.
    """
    target, basis = planned_figures(bench), basis_of(bench.profile)
    response = Model(bench, basis).response(progress=progress)
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
    tolerance, and so does the last of them. The first swing has the weights `start` (m,), by default those
    where the problem begins. `on_attempt` is called after each swing.

    Raises:
        Refused: the robot does not come back to its address.
    """
    learner = Learner(problem.response, problem.target, problem.path, problem.beginning)
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


Cycles = np.ndarray[Any, Any]


class Recorded(NamedTuple):
    """A swing that the robot made, not its first after arming."""

    profile: Profile
    """Profile of the swing, a correction included."""
    cycles: Cycles
    """CYCLE records from its first tick."""
    encoders: Encoders
    """Encoders with the calibration of that time."""


def read_recorded(paths: Sequence[Path]) -> list[Recorded]:
    """Return the swings in Parquet files.

    Raises:
        BenchError: one is no record, holds no whole swing, or was planned otherwise than the first.
    """
    swings: list[Recorded] = []
    for path in paths:
        cycles, metadata = read_swing(path)
        profile = read_profile(metadata, str(path))
        require_alike(swings[0].profile if swings else profile, profile, str(path))
        encoders = plant_of(metadata, str(path))[0].encoders
        swings.append(Recorded(profile, from_first_tick(cycles, profile, str(path)), encoders))
    return swings


def from_first_tick(cycles: Cycles, profile: Profile, location: str) -> Cycles:
    """Return the records of a swing from its first tick on.

    Raises:
        BenchError: they hold no swing up to the impact window.
    """
    begun = np.flatnonzero(cycles["phase"] == Phase.BACKSWING)
    first = int(begun[0]) - profile.begins[1] if begun.size else -1
    swing = cycles[max(first, 0) :]
    if first < 0 or len(swing) < profile.begins[5] or swing["cause"][: profile.begins[5]].any():
        raise BenchError(
            location,
            "no complete swing",
            "a swing from the address to the ball",
            "Give a record of a complete swing.",
        )
    return swing


def require_alike(one: Profile, other: Profile, location: str) -> None:
    """Refuse swings with different plans or corrections; `location` names the compared record.

    Raises:
        BenchError: they were not.
    """
    if digest_of(one) != digest_of(other):
        found = f"a swing of {other.name}" + (", with another correction" if one.name == other.name else "")
        raise BenchError(
            location, found, f"of {one.name}, as in the records before", "Identify one at a time."
        )


_IDENTIFIED = ((0.3, 0.6, 0.2, 0.3), 0.002, 0.3, 0.1)
"""Difference of the first delivery from the expected one, tolerances and rad, share by which the response
differed from the identified one, and radius, found with random and worn robots."""
_MAX_RESIDUAL = 10.0
"""Max error after identification, tolerances; it was at most one where identification found the robot."""
_ANYTHING = (1e4,) * 4
"""Replaces the first of them without recorded swings."""
_SWINGS = 3
"""Simulated swings that are averaged; one before them begins with the air of arming."""


def begun_on(
    problem: LearningProblem, plant: PlantParameters, recorded: Sequence[Recorded] = ()
) -> LearningProblem:
    """Return `problem` in its initial state for a robot identified as `plant` from `recorded` swings.

    Without `recorded` the remaining model error is unknown: identification then only improves the first
    swing.

    Raises:
        BenchError: the learned or a recorded swing was stopped or missed the ball, or `plant` is not the
            recorded robot.
        Refused: it does not reach its address.
    """
    bench = problem.bench
    beyond = left_over(bench, plant, recorded) if recorded else np.zeros(4)
    off = np.abs(beyond / Tolerance().scale(problem.target)).max()
    if off > _MAX_RESIDUAL:
        found, expected = (
            f"a robot that delivers {off:.0f} tolerances off the records",
            f"at most {_MAX_RESIDUAL:g}",
        )
        raise BenchError("--identified", found, expected, "Identify it again, from swings of this robot.")
    swing = on_series(problem, Series(bench, quiet(plant)))
    aim = problem._replace(target=Figures(*map(float, problem.target.array - beyond)))
    weights = learn(aim, swing).weights
    response = Model(bench, problem.basis, plant).response(weights)
    swings = [swing(weights) for _ in range(_SWINGS)]
    figures = np.mean([swung.figures.array for swung in swings], axis=0) + beyond
    path = np.mean([swung.cycles["angle"][response.rows] for swung in swings], axis=0)
    about = response._replace(figures=figures, path=path)
    known = _IDENTIFIED if recorded else (_ANYTHING, max(_ANYTHING), DOUBT, RADIUS)
    return problem._replace(beginning=Beginning(weights, about, *known))


def left_over(bench: Bench, plant: PlantParameters, recorded: Sequence[Recorded]) -> Array:
    """Return the delivery (4,) of the swings `recorded` less that of `plant` with their profile.

    Raises:
        BenchError: one was stopped or missed the ball, on the robot or on `plant`.
    """
    bench = bench._replace(profile=recorded[0].profile)
    free = Model(bench, basis_of(bench.profile)).free()

    def figures(cycles: Cycles, encoders: Encoders) -> Array:
        # Measured as in learning, by the same model on both sides of the difference.
        seen = delivery_from_encoders(cycles, replace(bench.model, encoders=encoders), free)
        if seen is None:
            raise BenchError(
                "a recorded swing",
                "no contact with the ball",
                "a swing that strikes the ball",
                "Leave this record out of --records.",
            )
        return figures_of(seen).array

    series = Series(bench, quiet(plant))
    series.swing(bench.profile)
    simulated = [series.swing(bench.profile).cycles for _ in range(_SWINGS)]
    before = np.mean([figures(cycles, bench.model.encoders) for cycles in simulated], axis=0)
    return np.asarray(np.mean([figures(one.cycles, one.encoders) for one in recorded], axis=0) - before)
