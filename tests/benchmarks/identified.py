"""What identification saves in learning swings: `... identified [--draws N] [--folder DIR]`.

Robots as in `learning`, each armed anew. Three swings of the shipped profile identify each.
Then it learns in three ways: without that; beginning where the identified robot ends in simulation, with what
identification left over; and with a swing designed anew on the identified robot, of the same head speed and
attack angle, lean as is easiest. With `--folder` what was identified and designed is kept there, and taken
from there when it is there already.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.config import Configuration, load_configuration, shipped_configuration
from bench.design.designer import DesignFailed, SwingDemand, design_swing
from bench.errors import BenchError, Refused
from bench.learning.beginning import begun_on
from bench.learning.figures import Tolerance, figures_of
from bench.learning.identify import identify
from bench.learning.learn import LearningProblem, learn, on_series, prepare
from bench.learning.plant_file import plant_file, write_plant_file
from bench.learning.recorded import Recorded
from bench.simulation.series import Bench, Series
from bench.simulation.variation import WORN, Variation, drawn
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile, save_profile
from sim.plant import PlantParameters
from tests.benchmarks.row import Row
from tests.benchmarks.swept import add_engine_options, swept

NAME = "identified"
RECORDED, CHECKED = 3, 5
_WAYS = ("without", "identified", "designed anew")

Array = NDArray[np.float64]


class Outcome(NamedTuple):
    """What became of one robot that learned in one way; errors in tolerances, of the worst figure."""

    first: float
    """Of the first swing."""
    second: float
    used: int
    after: float
    """Of the mean of five further swings, as the plant knows it."""


@dataclass(frozen=True)
class IdentifiedRobots:
    """How robots learn in all ways, by name and variation."""

    problem: LearningProblem
    configuration: Configuration
    folder: Path

    def prepared(self) -> Callable[[tuple[str, Variation]], list[tuple[str, Outcome]]]:
        """Return the function of a robot."""
        return lambda robot: _in_all_ways(*robot, self.problem, self.configuration, self.folder)


def run(arguments: list[str]) -> list[Row]:
    """Let all robots learn in all ways; tell of each on the way."""
    parser = argparse.ArgumentParser(prog=f"python -m tests.benchmarks {NAME}", description=__doc__)
    parser.add_argument("--draws", type=int, default=8, help="robots drawn (default: %(default)s)")
    parser.add_argument("--folder", type=Path, default=None, help="where robots and swings are kept")
    add_engine_options(parser)
    options = parser.parse_args(arguments)
    configuration = load_configuration(shipped_configuration())
    profile = load_profile(find_profile(configuration.swing.profile))
    problem = prepare(_bench(configuration, profile))
    plant = configuration.plant
    robots = {"worn": WORN} | {f"draw-{n}": drawn(n, plant) for n in range(1, options.draws + 1)}
    outcomes: dict[str, dict[str, Outcome]] = {way: {} for way in _WAYS}
    with TemporaryDirectory() as passing:
        folder = options.folder or Path(passing)
        study = IdentifiedRobots(problem, configuration, folder)
        found = swept(options, study, list(robots.items()), "identifying", configuration)
        for name, ways in zip(robots, found, strict=True):
            for way, outcome in ways:
                outcomes[way][name] = outcome
                print(
                    f"{name}, {way}: first swing {outcome.first:.1f}, second {outcome.second:.1f}, "
                    f"{outcome.used} learning swings, {outcome.after:.2f} after",
                    flush=True,
                )
    return _rows(outcomes, len(robots))


def _bench(configuration: Configuration, profile: Profile) -> Bench:
    c = configuration
    return Bench(c.plant, profile, c.control, c.envelope, c.estimator)


def _in_all_ways(
    name: str, variation: Variation, problem: LearningProblem, configuration: Configuration, folder: Path
) -> list[tuple[str, Outcome]]:
    truth, profile = variation.applied_to(problem.bench.model), problem.bench.profile
    series = Series(problem.bench, truth)
    swings = [series.swing(profile).cycles for _ in range(RECORDED)]
    recorded = [Recorded(profile, cycles, truth.encoders) for cycles in swings]
    file = folder / f"{name}.toml"
    if not file.exists():
        found = identify(problem.bench, swings)
        robot = found.variation(problem.bench).applied_to(problem.bench.model)
        write_plant_file(file, plant_file(robot, found, configuration))
        print(f"{name}: swings as recorded within {found.after:.1f}, before {found.before:.1f}", flush=True)
    identified = load_configuration(file)
    outcomes = [("without", _taught(problem, truth))]
    for way in _WAYS[1:]:
        try:
            if way == "identified":
                begun = begun_on(problem, identified.plant, recorded)
            else:
                anew = _designed_anew(problem, identified, folder / f"{name}-anew.toml")
                begun = begun_on(prepare(_bench(identified, anew)), identified.plant, recorded)
            outcomes.append((way, _taught(begun, truth)))
        except (BenchError, DesignFailed, Refused) as failure:
            print(f"{name}, {way}: NOT: {failure}", flush=True)
    return outcomes


def _designed_anew(problem: LearningProblem, robot: Configuration, file: Path) -> Profile:
    """Return a swing for `robot` with the speed and attack angle that are the target."""
    if not file.exists():
        demand = SwingDemand(head_speed=problem.target.speed, attack=problem.target.attack)
        made = design_swing(
            robot.plant,
            demand,
            file.stem,
            control=robot.control,
            envelope=robot.envelope,
            estimator=robot.estimator,
            start=problem.bench.profile,
        )
        save_profile(file, made.profile)
    return load_profile(file)


def _taught(problem: LearningProblem, truth: PlantParameters) -> Outcome:
    series = Series(problem.bench, truth)
    result = learn(problem, on_series(problem, series))
    swing, scale = result.correction.applied_to(problem.bench.profile), Tolerance().scale(problem.target)
    figures = [figures_of(series.swing(swing).delivery).array for _ in range(CHECKED)]
    after = (np.mean(figures, axis=0) - problem.target.array) / scale
    first, second = (_worst(attempt.error) for attempt in result.attempts[:2])
    return Outcome(first, second, result.used, _worst(after))


def _worst(error: Array) -> float:
    return float(np.abs(error).max())


def _rows(outcomes: dict[str, dict[str, Outcome]], robots: int) -> list[Row]:
    rows = []
    # Compared are the same robots: those that learned in this way and without.
    for way in _WAYS:
        made = outcomes[way]
        rows.append(Row(NAME, f"{way}: robots", len(made), "", f"of {robots}"))
        if not made:
            continue
        values = np.array(list(made.values()))
        for column, figure in enumerate(("first swing off", "second swing off", "learning swings")):
            rows.append(_mean(f"{way}: {figure}", values[:, column], "" if column == 2 else "tolerances"))
        rows.append(Row(NAME, f"{way}: within the tolerances", int(np.sum(values[:, 3] <= 1.0)), "robots"))
        if way != "without":
            saved = np.array([outcomes["without"][name].used - made[name].used for name in made])
            rows.append(_mean(f"{way}: learning swings saved", saved.astype(float), "", at_least=0.0))
    return rows


def _mean(name: str, values: Array, unit: str, at_least: float | None = None) -> Row:
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")
    note = f"mean of {len(values)}, its standard error {error:.2g}"
    return Row(NAME, name, float(values.mean()), unit, note, at_least=at_least)
