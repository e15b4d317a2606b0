"""Step: the swing is learned on the robot itself, with the response of the robot as it was measured.

Encoders show the strike on the face as far as lengths are known, which no step measures. Where the ball's
mark is read, the strike is the encoders' plus what the marks so far lay beside it; a mark is asked for after
the first swing, and after each that would do.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.commissioning.rising_swings import bench_of, require_safe
from bench.commissioning.steps import (
    LEARNED_FILE,
    SWING_FILE,
    StepResult,
    SwingSeries,
    SwungRobot,
    WrongMachine,
)
from bench.config import Configuration
from bench.learning.delivery import Figures, Tolerance, delivery_from_encoders, figures_of, strike_from_mark
from bench.learning.ilc import LearningSettings
from bench.learning.learn import LearningProblem, LearningResult, ObservedSwing, learn, prepare
from bench.simulation.series import SeriesSwing
from bench.swing.profile import load_profile, save_profile

_SWINGS = 20
"""Max learning swings."""
_FARTHEST = 0.010
"""Max distance (m) of a mark from the encoders' strike that lengths explain: another ball left it, or it was
misread."""


class LearnedSwing:
    """Learning of the swing that was found."""

    name, title = "learning", "Learning the swing"
    bounds_text = (
        f"at most {_SWINGS} swings at the speed of the step before, corrections bounded; "
        "a swing that leaves its limits is stopped"
    )

    def swing(
        self, robot: SwungRobot, known: Configuration, folder: Path, progress: Callable[[str], None]
    ) -> StepResult:
        """Learn the profile of the step before on `robot`, and store it corrected in `folder`.

        Raises:
            WrongMachine: the tolerances are not reached, or a load is beyond a rating.
            Refused: the robot does not come back to its address.
        """
        profile = load_profile(folder / SWING_FILE)
        progress("the response of the measured robot")
        problem = prepare(bench_of(known, profile))
        series, made = robot.series(problem.bench), list[SeriesSwing]()
        marks = _Marks(problem, series)

        def swing(weights: NDArray[np.float64]) -> ObservedSwing:
            progress(f"learning swing {len(made)}")
            swung = series.swing(problem.basis.correction(weights).applied_to(profile))
            require_safe(series.loads(), f"learning swing {len(made)}")
            made.append(swung)
            return ObservedSwing(swung.cycles, marks.figures(swung), swung.cause, swung.settled)

        result = learn(problem, swing, LearningSettings(swings=_SWINGS))
        save_profile(folder / LEARNED_FILE, result.correction.applied_to(profile))
        figures = _Learned(result, figures_of(made[result.chosen].delivery))
        if not result.within:
            raise WrongMachine(
                "learning",
                f"after {result.used} swings {figures.text}",
                "a swing within 2 mm, 0.3 %, 0.3 deg and 0.3 deg of its target",
                "Look for what changes between swings: play, a slipping shaft, the supply; then --resume.",
            )
        learned = f"learned in {result.used} swings: {figures.text}"
        return StepResult((), (learned, marks.text, *figures.truth))


class _Learned(NamedTuple):
    result: LearningResult
    true: Figures
    """The kept swing's delivery as a simulated plant knows it."""

    @property
    def text(self) -> str:
        """The kept swing by its source, beside the target."""
        kept, target = self.result.attempts[self.result.chosen].figures, self.result.target
        return f"{_words(kept)}; target {_words(target)}"

    @property
    def truth(self) -> tuple[str, ...]:
        """The kept swing as the simulated plant knows it; empty on a real robot."""
        return () if np.isnan(self.true.speed) else (f"the simulated plant knows: {_words(self.true)}",)


def _words(f: Figures) -> str:
    angles = f"lean {np.degrees(f.lean):+.2f} deg, attack {np.degrees(f.attack):+.2f} deg"
    return f"{f.speed:.2f} m/s, strike {1e3 * f.strike:+.1f} mm, {angles}"


class _Marks:
    """The strike on the face by encoders and marks."""

    def __init__(self, problem: LearningProblem, series: SwingSeries) -> None:
        self._problem, self._series = problem, series
        self._read, self._beside, self._strange = True, list[float](), list[float]()

    def figures(self, swung: SeriesSwing) -> Figures:
        """Return the figures of `swung`, the last swing; unknown after a stop."""
        problem = self._problem
        delivery = (
            None
            if swung.cause
            else delivery_from_encoders(swung.cycles, problem.bench.model, problem.response.free)
        )
        found = figures_of(delivery)
        if delivery is None:
            return found
        if self._read and (not self._beside or self._would_do(self._moved(found))):
            mark = self._series.face_mark(swung)
            if mark is None:
                self._read = False
            else:
                beside = strike_from_mark(*mark, problem.bench.model) - found.strike
                (self._beside if abs(beside) <= _FARTHEST else self._strange).append(beside)
        return self._moved(found)

    @property
    def text(self) -> str:
        """What the marks showed."""
        strange = ", ".join(f"{1e3 * beside:+.1f}" for beside in self._strange)
        told = f"; not believed, {strange} mm beside it" if strange else ""
        if not self._beside:
            return (
                "no mark on the face was read: the strike is the encoders', as true as the lengths are" + told
            )
        off = 1e3 * float(np.mean(self._beside))
        return (
            f"{len(self._beside)} marks on the face lay {off:+.1f} mm beside the encoders' strike: lengths"
            + told
        )

    def _moved(self, figures: Figures) -> Figures:
        """Return `figures` with the strike where the marks so far say it was."""
        beside = float(np.mean(self._beside)) if self._beside else 0.0
        return figures._replace(strike=figures.strike + beside)

    def _would_do(self, figures: Figures) -> bool:
        scale, target = Tolerance().scale(self._problem.target), self._problem.target.array
        return bool(np.all(np.abs(figures.array - target) <= scale))
