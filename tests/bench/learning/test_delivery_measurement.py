"""Delivery from encoders: readings that a blow or a cushion would spoil; the planned delivery."""

from __future__ import annotations

from dataclasses import replace
from math import asin, degrees, radians, sin
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.config import load_configuration, shipped_configuration
from bench.learning.delivery import delivery_from_encoders, planned_figures
from bench.learning.learn import prepare
from bench.simulation.plant_variation import drawn
from bench.simulation.simulated_bench import Bench, Series, SeriesSwing
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.impact import face_gap, impact_parameters
from sim.kinematics import forward_kinematics
from sim.plant import PlantParameters

Array = NDArray[np.float64]

ROWS, FIRST = 60, -40
SHOCK, AFTER_THE_BALL = -12.0, 0.0018
"""rad/s that the wrist loses at the ball; s after the ball at which a wrist without one meets its cushion."""


class Motion(NamedTuple):
    """Angles near the ball, a parabola with its contact at time 0 (s)."""

    pose: Array
    velocity: Array
    acceleration: Array

    def angle(self, time: Array | float) -> Array:
        """Return the angles (..., 3), rad."""
        t = np.asarray(time)[..., None]
        return np.asarray(self.pose + t * self.velocity + 0.5 * t * t * self.acceleration)


@pytest.fixture(scope="module")
def motion(plant: PlantParameters) -> Motion:
    """That of the shipped swing, with face and ball in contact at time 0."""
    profile = load_profile(find_profile("default"))
    k = round(profile.impact_time / profile.period)
    rate = (profile.angle[k + 1] - profile.angle[k - 1]) / (2 * profile.period)
    planned = Motion(profile.angle[k], rate, np.array([-20.0, -250.0, 500.0]))
    contact = _contact(planned, plant)
    return Motion(planned.angle(contact), rate + contact * planned.acceleration, planned.acceleration)


def _contact(motion: Motion, plant: PlantParameters) -> float:
    times: Array = np.linspace(-0.003, 0.003, 60_001)
    face = impact_parameters(plant.robot.club, plant.ball, plant.robot.lie)
    poses = forward_kinematics(plant.robot, motion.angle(times))
    site = plant.site
    gaps = [float(face_gap(x, y, turn, site.ball_x, site.ball_y, face)) for x, y, turn in poses.tolist()]
    return float(times[int(np.argmin(np.abs(gaps)))])


def _cycles(motion: Motion, plant: PlantParameters, shift: float) -> np.ndarray:
    """Return readings of `motion`, struck by the ball at time 0; a reading is `shift` ticks after it."""
    times: Array = plant.tick * (np.arange(FIRST, FIRST + ROWS, dtype=np.float64) + shift)
    angle = motion.angle(times) + np.maximum(times, 0.0)[:, None] * np.array([0.0, 0.0, SHOCK])
    encoders = plant.encoders
    per_rad = np.array(encoders.sign) * encoders.counts_per_revolution / (2 * np.pi)
    cycles = np.zeros(ROWS, [("encoder_count", np.int64, 3), ("angle", float, 3), ("phase", np.int64)])
    cycles["encoder_count"] = np.floor(angle * per_rad + np.array(encoders.zero_count))
    cycles["angle"], cycles["phase"] = angle, Phase.IMPACT
    return cycles


def _plan(motion: Motion, plant: PlantParameters) -> Array:
    """Return `motion` without a ball, with the wrist in its cushion soon after."""
    times: Array = plant.tick * np.arange(FIRST, FIRST + ROWS, dtype=np.float64)
    angle = motion.angle(times)
    angle[:, 2] -= 3000.0 * np.maximum(times - AFTER_THE_BALL, 0.0) ** 2
    return angle


def _speeds(motion: Motion, plant: PlantParameters, believed: PlantParameters) -> Array:
    """Return the head speed (20,) by the encoders, m/s, over all shifts of readings and contact."""
    plan, found = _plan(motion, plant), []
    for shift in np.linspace(0.0, 0.95, 20):
        delivery = delivery_from_encoders(_cycles(motion, plant, float(shift)), believed, plan)
        assert delivery is not None
        found.append(np.hypot(*delivery.velocity[:2]))
    return np.array(found)


def _true_speed(motion: Motion, plant: PlantParameters) -> float:
    step = 1e-6
    ends = forward_kinematics(plant.robot, motion.angle(np.array([-step, step])))[:, :2]
    return float(np.hypot(*(ends[1] - ends[0]))) / (2 * step)


def test_delivery_from_encoders_planned_cushion_keeps_head_speed(
    plant: PlantParameters, motion: Motion
) -> None:
    speeds = _speeds(motion, plant, plant)
    assert np.abs(speeds / _true_speed(motion, plant) - 1).max() < 2e-3


@pytest.mark.parametrize("nearer", [0.006, 0.012])
def test_delivery_from_encoders_nearer_ball_keeps_head_speed(
    plant: PlantParameters, motion: Motion, nearer: float
) -> None:
    """The bench believes in a ball `nearer` m farther on than the one that is struck."""
    believed = replace(plant, site=replace(plant.site, ball_x=plant.site.ball_x + nearer))
    speeds = _speeds(motion, plant, believed)
    assert np.abs(speeds / _true_speed(motion, plant) - 1).max() < 2e-3


@pytest.mark.release
def test_delivery_from_encoders_varied_robots_keep_speed_error_small() -> None:
    profile = load_profile(find_profile("default"))
    bench = Bench(profile)
    plan, errors = prepare(bench).response.free, []
    for seed in (4, 10, 27):
        series = Series(bench, drawn(seed, bench.plant).applied_to(bench.plant))
        swings = [series.swing(profile) for _ in range(4)]
        errors.append(np.mean([_error(swing, bench.plant, plan) for swing in swings]))
    assert np.abs(errors).max() < 0.0015, errors  # with a parabola 0.0014 to 0.0025


def _error(swing: SeriesSwing, model: PlantParameters, plan: Array) -> float:
    """Return by what share the measured speed is wrong."""
    measured = delivery_from_encoders(swing.cycles, model, plan)
    assert measured is not None
    assert swing.delivery is not None
    return measured.speed / swing.delivery.speed - 1.0


SHIPPED = load_configuration(shipped_configuration())
BENCH = Bench(load_profile(find_profile("average-male")), SHIPPED.plant, SHIPPED.control, SHIPPED.envelope)


def test_planned_figures_match_profile_delivery() -> None:
    planned, told = planned_figures(BENCH).shown, BENCH.profile.delivery
    assert planned["head_speed_mps"] == pytest.approx(told["head_speed_mps"], abs=0.001)
    assert planned["attack_angle_deg"] == pytest.approx(told["attack_angle_deg"], abs=0.001)
    assert planned["strike_mm"] == pytest.approx(told["in_plane_error_mm"], abs=0.001)
    assert planned["head_speed_mps"] == pytest.approx(41.57, abs=0.05)


def test_planned_figures_attack_angle_accounts_for_lie() -> None:
    rising = replace(BENCH.profile, delivery=BENCH.profile.delivery | {"path_slope_deg": 2.5})
    seen = planned_figures(replace(BENCH, profile=rising)).attack
    assert degrees(seen) == pytest.approx(
        degrees(asin(sin(radians(2.5)) * sin(BENCH.plant.robot.lie))), abs=1e-9
    )


def test_planned_figures_profile_without_delivery_is_refused() -> None:
    without = replace(BENCH, profile=replace(BENCH.profile, delivery={}))
    for aimed in (planned_figures, prepare):
        with pytest.raises(BenchError, match="in_plane_error_mm"):
            aimed(without)
