"""The swings of driver and bag, learned on robots that differ from the one that the bench believes in.

The robots are those of `learning`: friction and dead volume of each joint, flow of each valve, supply, vane
and head mass uniformly within 10 %, up to 1 ms more latency; seeds 1 to `--draws`. Each learns for at most
twelve swings by its encoders what the profile plans; judged is the mean of five further swings with the kept
correction, as the plant knows it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import degrees, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.errors import Refused
from bench.learning.figures import Tolerance, figures_of
from bench.learning.learn import LearningProblem, learn, on_series, prepare
from bench.simulation.series import Bench, Series
from bench.simulation.variation import drawn
from tests.bench.design.bag_demands import ALL_DEMANDS, mounted
from tests.benchmarks.row import Row
from tests.benchmarks.swept import add_engine_options, swept
from tests.benchmarks.whole_table import print_whole

NAME = "bag_learning"
CHECKED = 5
TOLERANCES = {
    "learner": Tolerance(),
    "design": Tolerance(strike=0.0005, speed=0.002, lean=radians(0.1), attack=radians(0.1)),
}
"""The learner's own, and those that a designed swing is held to on the robot it was designed for."""

_TITLE = f"off the demand: first swing, mean of {CHECKED} learned ones (their standard deviation)"
_COLUMNS = ("swing", "robot", "swings", "stops", "strike, mm", "speed, %", "lean, deg", "attack, deg")

Array = NDArray[np.float64]


class LearnedSwing(NamedTuple):
    """What became of one swing on one robot."""

    profile: str
    seed: int
    before: Array
    """(4,) first swing less its demand: strike m, speed m/s, lean rad, attack rad; NaN if it was stopped."""
    after: Array
    """(4,) the same of the mean of the checked swings."""
    spread: Array
    """(4,) standard deviation of these."""
    used: int
    stops: int
    found: str
    """Why nothing was learned; empty if it was."""


@dataclass(frozen=True)
class BagLearning:
    """What becomes of a swing on drawn robots, by seed."""

    profile: str
    problem: LearningProblem
    tolerance: Tolerance

    def prepared(self) -> Callable[[int], LearnedSwing]:
        """Return the function of a seed."""
        return self._learned

    def _learned(self, seed: int) -> LearnedSwing:
        problem, bench = self.problem, self.problem.bench
        demand, nothing = problem.target, np.full(4, np.nan)
        try:
            series = Series(bench, drawn(seed, bench.model).applied_to(bench.model))
            result = learn(problem, on_series(problem, series), tolerance=self.tolerance)
            swing = result.correction.applied_to(bench.profile)
            figures = np.array([figures_of(series.swing(swing).delivery).array for _ in range(CHECKED)])
        except Refused as refusal:
            return LearnedSwing(self.profile, seed, nothing, nothing, nothing, 0, 0, str(refusal))
        stops = sum(bool(attempt.cause) for attempt in result.attempts)
        before = result.attempts[0].figures.array - demand.array
        after = figures.mean(axis=0) - demand.array
        return LearnedSwing(
            self.profile, seed, before, after, figures.std(axis=0, ddof=1), result.used, stops, ""
        )


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Let all swings be learned, print each, and return the largest deviations."""
    parser = argparse.ArgumentParser(prog=f"python -m tests.benchmarks {NAME}", description=__doc__)
    parser.add_argument("--draws", type=int, default=3, help="robots drawn (default: %(default)s)")
    parser.add_argument(
        "--profiles", nargs="+", choices=ALL_DEMANDS, default=list(ALL_DEMANDS), metavar="NAME"
    )
    parser.add_argument("--tolerance", choices=TOLERANCES, default="learner", help="what learning aims at")
    add_engine_options(parser)
    options = parser.parse_args(arguments)
    tolerance, learned = TOLERANCES[options.tolerance], list[LearnedSwing]()
    for name in options.profiles:
        bench = mounted(name)
        problem = prepare(Bench(bench.plant, bench.profile, bench.control, bench.envelope, bench.estimator))
        study = BagLearning(name, problem, tolerance)
        learned += swept(options, study, range(1, options.draws + 1), name)
    print_whole(_TITLE, _COLUMNS, map(_shown, learned))
    return _rows(learned, tolerance)


def _shown(swing: LearnedSwing) -> tuple[str, ...]:
    """Return the row of one swing on one robot."""
    if swing.found:
        return swing.profile, str(swing.seed), swing.found
    values = (figures * _units(swing.profile) for figures in (swing.before, swing.after, swing.spread))
    off = zip(*values, (2, 3, 3, 3), strict=True)
    figures = (f"{a:+.2f}, {b:+.{places}f} ({spread:.{places}f})" for a, b, spread, places in off)
    return swing.profile, str(swing.seed), str(swing.used), str(swing.stops), *figures


def _units(profile: str) -> Array:
    """Return what makes figures (4,) mm, % and degrees."""
    return np.array([1e3, 100 / ALL_DEMANDS[profile].speed, degrees(1.0), degrees(1.0)])


def _rows(learned: Sequence[LearnedSwing], tolerance: Tolerance) -> list[Row]:
    off = np.array([np.abs(swing.after) * _units(swing.profile) for swing in learned])
    limits = (
        1e3 * tolerance.strike,
        100 * tolerance.speed,
        degrees(tolerance.lean),
        degrees(tolerance.attack),
    )
    within = int(np.sum(np.all(off <= limits, axis=1)))
    figures = zip(
        ("strike", "speed", "lean", "attack"), ("mm", "%", "deg", "deg"), off.max(axis=0), limits, strict=True
    )
    return [
        Row(NAME, "swings learned", within, "", f"of {len(learned)}", at_least=len(learned)),
        *(
            Row(NAME, f"{name} off its demand after learning, at most", float(worst), unit, at_most=limit)
            for name, unit, worst, limit in figures
        ),
        Row(NAME, "learning swings, mean", float(np.mean([swing.used for swing in learned])), ""),
        Row(NAME, "stops in all learning swings", sum(swing.stops for swing in learned), ""),
    ]
