"""Learning on robots that differ from the one that the bench believes in: `... learning [--draws N]`.

The configuration is the shipped one, with its profile and the limits of the model-based check. One robot is
worn: friction +40 %, valve flow -8 %, supply -4 %, head +10 g, vane +3 %, encoder latency +1 ms. The others
are drawn: friction and dead volume of each joint, flow of each valve, supply, vane and head mass uniformly
within 10 %, up to 1 ms more latency; seeds 1 to N.
Each learns for at most twelve swings by its encoders; evaluated is the plant's truth, in the mean of five
swings with the kept correction. The worn robot then makes a hundred with noise in encoders, which the
estimator models, and in the supply.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.config import load_configuration, shipped_configuration
from bench.learning.delivery import Tolerance, figures_of
from bench.learning.learn import LearningProblem, LearningResult, learn, on_series, prepare
from bench.simulation.plant_variation import WORN, Variation, drawn
from bench.simulation.simulated_bench import Bench, Series
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.plant import PlantParameters, build_plant
from tests.benchmarks.row import Row
from tests.benchmarks.swept import add_engine_options, swept

NAME = "learning"
CHECKED = 5
REPEATED = 100
ENCODER_NOISE = 2e-5
"""rad"""
SUPPLY_SCATTER = 0.002
"""Share, from swing to swing."""

Array = NDArray[np.float64]


class Outcome(NamedTuple):
    """What became of one robot; errors in tolerances."""

    robot: str
    before: Array
    after: Array
    used: int
    stops: int
    saturated: float
    supply: float

    @property
    def learned(self) -> bool:
        """Whether every figure is within its tolerance."""
        return bool(np.all(np.abs(self.after) <= 1.0))

    @property
    def text(self) -> str:
        """A line about this robot."""
        before, after = (np.array2string(v, precision=2) for v in (self.before, self.after))
        told = "learned" if self.learned else f"NOT learned: {self.why}"
        return f"{self.robot}: {before} -> {after} in {self.used} swings, {told}"

    @property
    def why(self) -> str:
        """What to say of a robot that did not learn."""
        names = ("strike", "speed", "lean", "attack")
        worst = int(np.argmax(np.abs(np.nan_to_num(self.after, nan=np.inf))))
        valves = f"a valve at its limit for {100 * self.saturated:.0f} % of the downswing"
        return (
            f"{names[worst]} {self.after[worst]:+.1f} tolerances, {valves}, supply {self.supply:.3f}, "
            f"{self.stops} stops"
        )


@dataclass(frozen=True)
class LearningDraws:
    """What becomes of drawn robots, by seed; a line for one that comes back from no stop."""

    problem: LearningProblem

    def prepared(self) -> Callable[[int], Outcome | str]:
        """Return the function of a seed."""

        def taught(seed: int) -> Outcome | str:
            variation = drawn(seed, self.problem.bench.plant)
            try:
                return _taught(self.problem, f"seed {seed}", variation)[0]
            except Refused as refusal:  # after a stop it did not come back: this robot learned nothing
                return f"seed {seed}: NOT learned: {refusal}"

        return taught


def run(arguments: list[str]) -> list[Row]:
    """Run the learning of all robots; print each result."""
    parser = argparse.ArgumentParser(prog=f"python -m tests.benchmarks {NAME}", description=__doc__)
    parser.add_argument("--draws", type=int, default=50, help="robots drawn (default: %(default)s)")
    add_engine_options(parser)
    options = parser.parse_args(arguments)
    shipped = load_configuration(shipped_configuration())
    file = find_profile(shipped.swing.profile)
    profile = load_profile(file)
    c = configuration = shipped.for_profile(profile, file)
    problem = prepare(Bench.of(c, profile))
    worn, result, plant = _taught(problem, "worn", WORN)
    print(worn.text, flush=True)
    seeds = range(1, options.draws + 1)
    learned = swept(options, LearningDraws(problem), seeds, "learning", configuration)
    for line in learned:
        print(line if isinstance(line, str) else line.text, flush=True)
    outcomes = [outcome for outcome in learned if isinstance(outcome, Outcome)]
    good = sum(outcome.learned for outcome in outcomes)
    rows = [
        Row(NAME, f"worn robot: {name} off before", float(value), f"x {unit}")
        for name, value, unit in zip(_NAMES, worn.before, _UNITS, strict=True)
    ]
    rows += [
        Row(NAME, f"worn robot: {name} off after", abs(float(value)), f"x {unit}", at_most=1.0)
        for name, value, unit in zip(_NAMES, worn.after, _UNITS, strict=True)
    ]
    rows.append(Row(NAME, "drawn robots that learned", good, "", at_least=round(0.9 * options.draws)))
    rows.append(Row(NAME, "learning swings, mean", float(np.mean([o.used for o in outcomes])), ""))
    rows.append(Row(NAME, "stops in all learning swings", sum(o.stops for o in outcomes), ""))
    off = _repeated(problem, result, plant)
    for name, mean, spread, unit in zip(_NAMES, off.mean(axis=0), off.std(axis=0), _UNITS, strict=True):
        rows.append(Row(NAME, f"{REPEATED} swings with noise: {name} off, mean", float(mean), f"x {unit}"))
        rows.append(Row(NAME, f"{REPEATED} swings with noise: {name}, SD", float(spread), f"x {unit}"))
    return rows


_NAMES = ("strike", "head speed", "shaft lean", "attack angle")
_UNITS = ("2 mm", "0.3 %", "0.3°", "0.3°")


def _taught(
    problem: LearningProblem, robot: str, variation: Variation
) -> tuple[Outcome, LearningResult, PlantParameters]:
    plant = variation.applied_to(problem.bench.plant)
    series = Series(problem.bench, plant)
    result = learn(problem, on_series(problem, series))
    swing, scale = result.correction.applied_to(problem.bench.profile), Tolerance().scale(problem.target)
    figures = [figures_of(series.swing(swing).delivery).array for _ in range(CHECKED)]
    outcome = Outcome(
        robot,
        result.error(result.attempts[0]),
        (np.mean(figures, axis=0) - problem.target.array) / scale,
        result.used,
        sum(bool(attempt.cause) for attempt in result.attempts),
        result.attempts[result.chosen].saturated,
        variation.supply,
    )
    return outcome, result, plant


def _repeated(problem: LearningProblem, result: LearningResult, plant: PlantParameters) -> Array:
    """Return how far many swings with noise are off the target (n, 4), in tolerances."""
    noisy = replace(plant, encoders=replace(plant.encoders, noise=ENCODER_NOISE))
    estimator = replace(problem.bench.estimator, noise=(ENCODER_NOISE,) * 3)
    series = Series(replace(problem.bench, estimator=estimator), noisy)
    swing, random = result.correction.applied_to(problem.bench.profile), np.random.default_rng(1)
    series.swing(swing)
    figures = []
    for _ in range(REPEATED):
        pressure = plant.supply.pressure * (1 + SUPPLY_SCATTER * float(random.standard_normal()))
        supply = replace(plant.supply, pressure=pressure)
        series._engine.stepper.plant = build_plant(replace(noisy, supply=supply))
        figures.append(figures_of(series.swing(swing).delivery).array)
    return np.asarray((figures - problem.target.array) / Tolerance().scale(problem.target))
