"""Encoders: resolution, latency, jitter, noise, and the random stream behind them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.compiled import new_record
from drivers.base.records import COMMAND, READINGS
from sim.plant import Encoders, Plant, PlantParameters, advance, build_plant, initial_state
from sim.sensors import sense

POSE = np.array([0.2, 4.3, 6.0])
SAMPLES = 100 if numba.config.DISABLE_JIT else 4000
COUNTS = 2**17


def plant_with(encoders: Encoders, seed: int = 1) -> Plant:
    return build_plant(PlantParameters(encoders=encoders, seed=seed))


def sensed(plant: Plant, state: Any, n: int = 1) -> NDArray[np.float64]:
    """Return `n` readings of the same state as angles (n, 3) rad."""
    readings, angles = new_record(READINGS), np.zeros((n, 3))
    for k in range(n):
        sense(plant.plant, state, readings)
        angles[k] = readings["encoder_count"][0] * (
            2 * np.pi / plant.parameters.encoders.counts_per_revolution
        )
    return angles


def turning(plant: Plant, speed: float) -> Any:
    """Return a state whose joints have turned steadily, as `history` shows it, and stand at POSE now."""
    state = initial_state(plant, POSE)
    substep = plant.parameters.tick / plant.parameters.substeps
    for back in range(60):
        state["history"][0, -back] = POSE - speed * substep * back
    state["time"] = 5.0
    return state


@pytest.mark.parametrize("counts", [256, 5000, 2**17])
def test_encoder_readings_are_whole_counts_within_one_turn(counts: int) -> None:
    plant = plant_with(Encoders(counts_per_revolution=counts))
    rng = np.random.default_rng(4)
    readings = new_record(READINGS)
    for _ in range(30):
        angle = rng.uniform(-10, 10, 3)
        sense(plant.plant, initial_state(plant, angle), readings)
        exact = np.mod(angle, 2 * np.pi) / (2 * np.pi) * counts
        assert readings["encoder_count"][0].tolist() == np.floor(exact).astype(int).tolist()


@pytest.mark.parametrize("latency", [0.0, 0.0001, 0.00025, 0.0011, 0.005])
def test_encoder_readings_are_delayed_by_latency(latency: float) -> None:
    plant = plant_with(Encoders(counts_per_revolution=2**24, latency=latency))
    state = turning(plant, 20.0)
    assert sensed(plant, state)[0] == pytest.approx(POSE - 20.0 * latency, abs=2 * np.pi / 2**24)
    readings = new_record(READINGS)
    sense(plant.plant, state, readings)
    assert readings["encoder_time"][0].tolist() == [5.0 - latency] * 3
    assert readings["encoder_age"][0].tolist() == [latency] * 3


def test_encoder_latency_with_moving_plant_stays_constant() -> None:
    plant = plant_with(Encoders(counts_per_revolution=2**24, latency=0.002))
    state, command = initial_state(plant, POSE), new_record(COMMAND)
    passed = [POSE]
    for _ in range(20):
        advance(*plant.records, state, command)
        passed.append(state["angle"][0].copy())
    assert sensed(plant, state)[0] == pytest.approx(passed[-3], abs=4e-7)


def test_encoder_noise_has_set_deviation_without_bias() -> None:
    plant = plant_with(Encoders(noise=1e-3))
    error = sensed(plant, initial_state(plant, POSE), SAMPLES) - POSE
    tolerance = 5 / np.sqrt(2 * error.size)
    assert np.std(error) == pytest.approx(1e-3, rel=tolerance)
    assert abs(np.mean(error)) < 5e-3 / np.sqrt(error.size) + 2 * np.pi / COUNTS
    assert abs(np.corrcoef(error[:, 0], error[:, 1])[0, 1]) < 5 / np.sqrt(SAMPLES)
    assert abs(np.corrcoef(error[:-1, 0], error[1:, 0])[0, 1]) < 5 / np.sqrt(SAMPLES)


def test_encoder_jitter_error_equals_speed_times_deviation() -> None:
    plant = plant_with(Encoders(latency=0.002, jitter=1e-4))
    error = sensed(plant, turning(plant, 20.0), SAMPLES) - (POSE - 20.0 * 0.002)
    assert np.std(error) == pytest.approx(20.0 * 1e-4, rel=5 / np.sqrt(2 * error.size))
    assert not np.ptp(sensed(plant, initial_state(plant, POSE), 20), axis=0).any()


def trace(seed: int, noise: float) -> tuple[bytes, bytes]:
    plant = plant_with(Encoders(noise=noise, jitter=noise / 10), seed)
    state, command, readings = initial_state(plant, POSE), new_record(COMMAND), new_record(READINGS)
    counts = []
    for k in range(30):
        command["valve"] = (0.5, -0.3, 0.2 * (k % 3))
        sense(plant.plant, state, readings)
        counts.append(readings["encoder_count"][0].tobytes())
        advance(*plant.records, state, command)
    return b"".join(counts), state["angle"].tobytes()


def test_encoder_noise_is_reproducible_per_seed() -> None:
    assert trace(1, 1e-3) == trace(1, 1e-3)
    readings, motion = zip(*(trace(seed, 1e-3) for seed in range(4)), strict=True)
    assert len(set(readings)) == 4
    assert len(set(motion)) == 1, "noise is the sensors' own; the plant's motion has none"


def test_encoder_without_noise_ignores_seed() -> None:
    assert trace(1, 0.0) == trace(2, 0.0)


def test_build_plant_latency_beyond_history_raises() -> None:
    parameters = PlantParameters(encoders=Encoders(latency=0.005), substeps=64)
    with pytest.raises(
        ValueError, match=r"encoders\.latency: found 0\.005 s .* expected .* up to 0\.00096875 s"
    ):
        build_plant(parameters)
    build_plant(replace(parameters, substeps=8))


def test_sense_spool_feedback_shows_spools_with_little_noise() -> None:
    plant = build_plant(replace(PlantParameters(), spool_feedback=True))
    state, command = initial_state(plant, POSE), new_record(COMMAND)
    command["valve"], readings = (0.5, -1.0, 0.0), new_record(READINGS)
    seen = []
    for _ in range(50):
        advance(*plant.records, state, command)
        sense(plant.plant, state, readings)
        seen.append(readings["spool_position"][0] - state["spool"][0])
    assert 0.004 < np.abs(seen).max() <= 0.005
    assert readings["spool_position"][0] == pytest.approx((0.5, -1.0, 0.0), abs=0.006)


def test_sense_without_spool_feedback_is_absent_and_draws_no_noise() -> None:
    plant = build_plant(PlantParameters())
    state, readings = initial_state(plant, POSE), new_record(READINGS)
    before = state["random"][0]
    sense(plant.plant, state, readings)
    assert np.isnan(readings["spool_position"]).all()
    assert state["random"][0] == before
