"""Beginning on an identified robot: what identification left over is made up for."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.config import load_configuration, shipped_configuration
from bench.learning.delivery import Tolerance
from bench.learning.learn import LearningProblem, Recorded, begun_on, left_over, on_series, prepare
from bench.simulation.plant_variation import Variation
from bench.simulation.series import Bench, Series
from bench.swing.library import find_profile
from bench.swing.profile import load_profile

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="a whole swing takes minutes without compilation"
)

SHIPPED = load_configuration(shipped_configuration())
PLANT = SHIPPED.plant
BENCH = Bench(PLANT, load_profile(find_profile(SHIPPED.swing.profile)), SHIPPED.control)
ROBOT = Variation(friction=(1.1, 0.95, 1.05), flow=(0.97, 1.02, 0.98), supply=0.99)
TRUTH = ROBOT.applied_to(PLANT)
IDENTIFIED = replace(ROBOT, flow=(0.96, 1.02, 0.98), supply=0.975).applied_to(PLANT)
"""Not quite it."""


@pytest.fixture(scope="module")
def problem() -> LearningProblem:
    return prepare(BENCH)


@pytest.fixture(scope="module")
def recorded() -> list[Recorded]:
    series = Series(BENCH, TRUTH)
    swings = [series.swing(BENCH.profile).cycles for _ in range(2)]
    return [Recorded(BENCH.profile, cycles, PLANT.encoders) for cycles in swings]


def mean_of_first(problem: LearningProblem) -> float:
    """Return how far the mean of the first three swings is off the plan, worst figure in tolerances."""
    assert problem.beginning is not None
    swing = on_series(problem, Series(BENCH, TRUTH))
    swings = [swing(problem.beginning.point) for _ in range(3)]
    figures = np.mean([swung.figures.array for swung in swings], axis=0)
    return float(np.abs((figures - problem.target.array) / Tolerance().scale(problem.target)).max())


@pytest.mark.release
def test_begun_on_left_over_correction_improves_first_swings(
    problem: LearningProblem, recorded: list[Recorded]
) -> None:
    scale = Tolerance().scale(problem.target)
    assert 0.7 < np.abs(left_over(BENCH, IDENTIFIED, recorded) / scale).max() < 2.0
    known, unknown = begun_on(problem, IDENTIFIED, recorded), begun_on(problem, IDENTIFIED)
    assert mean_of_first(known) < 1.0
    assert mean_of_first(known) < 0.7 * mean_of_first(unknown)
    assert known.beginning is not None
    expected = (known.beginning.response.figures - problem.target.array) / scale
    assert np.abs(expected).max() < 1.0


def test_left_over_true_robot_is_within_tolerance(problem: LearningProblem, recorded: list[Recorded]) -> None:
    off = left_over(BENCH, TRUTH, recorded) / Tolerance().scale(problem.target)
    assert np.abs(off).max() < 0.7


def test_begun_on_other_robot_than_recorded_raises_error(
    problem: LearningProblem, recorded: list[Recorded]
) -> None:
    other = Variation(head_mass=0.1).applied_to(PLANT)
    with pytest.raises(BenchError, match="off the records"):
        begun_on(problem, other, recorded)
