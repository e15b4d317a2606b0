"""Learning on the plant: a robot that differs from the model, delivery read from its encoders."""

from __future__ import annotations

import numpy as np
import pytest

from bench.base.lifecycle import Cause
from bench.config import load_configuration, shipped_configuration
from bench.learning.delivery import (
    Tolerance,
    delivery_from_encoders,
    figures_from,
    figures_of,
    planned_figures,
    strike_from_mark,
)
from bench.learning.learn import ENOUGH, SWINGS, LearningProblem, LearningResult, learn, on_series, prepare
from bench.simulation import plant_variation
from bench.simulation.plant_variation import Variation, drawn
from bench.simulation.simulated_bench import Bench, Series, SeriesSwing
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.plant import build_plant
from tests.compiled_only import needs_speed

pytestmark = needs_speed

SHIPPED = load_configuration(shipped_configuration())
PLANT = SHIPPED.plant
BENCH = Bench(load_profile(find_profile(SHIPPED.swing.profile)), PLANT, SHIPPED.control)
WORN = plant_variation.WORN.applied_to(PLANT)


@pytest.fixture(scope="module")
def problem() -> LearningProblem:
    return prepare(BENCH)


@pytest.fixture(scope="module")
def result(problem: LearningProblem) -> LearningResult:
    return learn(problem, on_series(problem, Series(BENCH, WORN)))


@pytest.fixture(scope="module")
def first() -> SeriesSwing:
    """Return the first swing of the robot as the bench knows it."""
    return Series(BENCH, PLANT).swing(BENCH.profile)


@pytest.mark.slow
def test_learn_worn_robot_reaches_planned_delivery(problem: LearningProblem, result: LearningResult) -> None:
    before, kept = result.attempts[0], result.attempts[result.chosen]
    alike = [result.error(one) for one in result.attempts if np.array_equal(one.point, kept.point)]
    assert np.abs(result.error(before)).max() > 4.0
    assert len(alike) >= 2
    assert np.abs(np.mean(alike, axis=0)).max() <= ENOUGH
    assert result.within
    assert result.used < SWINGS
    series = Series(BENCH, WORN)
    swing = result.correction.applied_to(BENCH.profile)
    truth = np.array([figures_of(series.swing(swing).delivery).array for _ in range(3)]).mean(axis=0)
    off = (truth - problem.target.array) / Tolerance().scale(problem.target)
    assert np.abs(off).max() <= 1.0


def test_prepare_target_equals_planned_figures(problem: LearningProblem) -> None:
    assert problem.target == planned_figures(BENCH)


def test_delivery_from_encoders_late_robot_matches_plant(problem: LearningProblem) -> None:
    """The worn robot's first swing comes when the modelled one has run into the wrist's cushion."""
    series, scale = Series(BENCH, WORN), Tolerance().scale(problem.target)
    swing = series.swing(BENCH.profile)
    truth = figures_of(swing.delivery).array
    seen = figures_of(delivery_from_encoders(swing.cycles, PLANT, problem.response.free)).array
    assert np.abs((truth - problem.target.array) / scale).max() > 4.0
    assert np.abs((seen - truth) / scale).max() < 3.0


def test_delivery_from_encoders_unknown_latency_matches_plant(problem: LearningProblem) -> None:
    """Also with a latency that the bench does not know."""
    swing = Series(BENCH, Variation(latency=0.001).applied_to(PLANT)).swing(BENCH.profile)
    truth = figures_of(swing.delivery)
    scale = Tolerance().scale(problem.target)
    seen = figures_of(delivery_from_encoders(swing.cycles, PLANT, problem.response.free))
    assert np.abs((seen.array - truth.array) / scale).max() < 0.6


def test_figures_from_other_source_replaces_measured_figures_only(
    problem: LearningProblem, first: SeriesSwing
) -> None:
    encoders = figures_from(first.cycles, PLANT, problem.response.free)
    marked = figures_from(first.cycles, PLANT, problem.response.free, mark=(-6.0, 4.5))
    assert marked.strike == pytest.approx(strike_from_mark(-6.0, 4.5, PLANT))
    assert marked.strike != pytest.approx(encoders.strike, abs=1e-3)
    assert marked[1:] == encoders[1:]
    monitor = figures_from(first.cycles, PLANT, problem.response.free, club_speed=42.0)
    assert monitor.speed == 42.0
    assert (monitor.strike, monitor.lean, monitor.attack) == (encoders.strike, encoders.lean, encoders.attack)


def test_strike_from_mark_matches_in_plane_error(first: SeriesSwing) -> None:
    assert first.delivery is not None
    toe, high = 1e3 * first.delivery.strike_x, 1e3 * first.delivery.strike_y
    assert strike_from_mark(toe, high, PLANT) == pytest.approx(first.delivery.in_plane_error, abs=1e-4)


def test_series_repeats_bit_for_bit_and_continues_after_stop(first: SeriesSwing) -> None:
    series = Series(BENCH, PLANT)
    assert series.swing(BENCH.profile).cycles.tobytes() == first.cycles.tobytes()
    weak = Variation(flow=(0.3, 1.0, 1.0)).applied_to(PLANT)
    series._engine.stepper.plant = build_plant(weak)
    stopped = series.swing(BENCH.profile)
    assert stopped.cause is Cause.SHOULDER_FOLLOWING
    series._engine.stepper.plant = build_plant(PLANT)
    assert series.swing(BENCH.profile).cause is Cause.NONE


def test_drawn_same_seed_repeats_variation_within_spread() -> None:
    assert drawn(7, PLANT) == drawn(7, PLANT)
    assert drawn(7, PLANT) != drawn(8, PLANT)
    for seed in range(20):
        variation = drawn(seed, PLANT)
        factors = (*variation.friction, *variation.flow, *variation.volume, variation.supply, variation.vane)
        assert all(0.9 <= factor <= 1.1 for factor in factors)
        assert abs(variation.head_mass) <= 0.1 * PLANT.robot.club.head_mass
        assert 0.0 <= variation.latency <= 0.001
