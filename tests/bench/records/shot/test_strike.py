"""Drift from swing to swing: a lasting loss of speed, and a ball that is met elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import nan
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Phase
from bench.config import load_configuration, shipped_configuration
from bench.records.shot.strike import (
    LASTING,
    NEEDED,
    REFERENCE,
    DriftMonitor,
    ObservedImpact,
    strike_seen,
    time_at_ball,
)
from bench.simulation.plant_variation import healthy_plant
from bench.simulation.simulated_bench import Bench, Series
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.plant import PlantParameters, build_plant
from sim.robot import RobotParameters
from tests.compiled_only import needs_speed

Cycles = np.ndarray[Any, Any]
BALL_X = 0.2315


def watch_after(swings: int, scatter: float = 0.0, seed: int = 1) -> DriftMonitor:
    """Return a watch that has seen healthy `swings`, 43 m/s on average."""
    random, watch = np.random.default_rng(seed), DriftMonitor()
    for _ in range(swings):
        seen = ObservedImpact(43.0 * (1.0 + scatter * random.normal()), 0.25 + 0.003 * random.normal())
        assert watch.take(seen, "a").warnings == ()
    return watch


def lost(watch: DriftMonitor, share: float, swings: int, tables: str = "a") -> list[tuple[str, ...]]:
    return [watch.take(ObservedImpact(43.0 * (1.0 - share), 0.25), tables).warnings for _ in range(swings)]


def test_drift_monitor_lasting_speed_loss_warns() -> None:
    found = lost(watch_after(REFERENCE, 0.001), 0.02, LASTING)
    assert [len(warnings) for warnings in found] == [0, 1, 1]  # the median of three
    assert "club speed 42.14 m/s" in found[-1][0]


def test_drift_monitor_single_slow_swing_gives_no_warning() -> None:
    watch = watch_after(REFERENCE, 0.001)
    assert lost(watch, 0.05, 1) == [()]
    assert lost(watch, 0.0, 5) == [()] * 5


def test_drift_monitor_insufficient_reference_gives_no_warning() -> None:
    assert lost(watch_after(NEEDED - 1), 0.2, 1) == [()]


def test_drift_monitor_other_tables_restart_reference() -> None:
    assert lost(watch_after(REFERENCE), 0.1, 5, "b") == [()] * 5


def test_drift_monitor_gradual_speed_loss_warns() -> None:
    watch = watch_after(REFERENCE, 0.001)
    found = [lost(watch, share, 1)[0] for share in np.linspace(0.0, 0.03, 60)]
    assert found[-1]


@pytest.mark.parametrize("seed", range(20))
def test_drift_monitor_one_percent_scatter_gives_no_warning(seed: int) -> None:
    watch_after(100, 0.01, seed)


@pytest.mark.parametrize("off", [0.025, -0.03])
def test_drift_monitor_shifted_ball_position_warns_immediately(off: float) -> None:
    watch = watch_after(REFERENCE)
    (text,) = watch.take(ObservedImpact(43.0, 0.25 + off), "a").warnings
    assert "the head met the ball" in text
    assert watch.take(ObservedImpact(43.0, nan), "a").warnings == ()  # no ball, nothing met


def test_drift_monitor_json_replaces_nan_with_null() -> None:
    told = DriftMonitor().take(ObservedImpact(43.0, nan), "a").as_json()
    assert told["club_speed_mps"] == 43.0
    assert told["ball_met_m"] is told["first_ball_met_m"] is None


def shipped() -> tuple[Series, Any, PlantParameters]:
    c = load_configuration(shipped_configuration())
    file = find_profile(c.swing.profile)
    profile = load_profile(file)
    c = c.for_profile(profile, file)
    plant = healthy_plant(c.plant, 1)
    envelope = c.envelope.with_model_check("off")
    return Series(Bench.of(replace(c, envelope=envelope), profile), plant), profile, plant


def swung(watch: DriftMonitor, series: Series, profile: Any, counts: int) -> tuple[str, ...]:
    cycles = series.swing(profile).cycles
    seen = strike_seen(cycles, counts, struck=True)
    assert seen is not None
    return watch.take(seen, "a").warnings


@needs_speed
@pytest.mark.timeout(300)
@pytest.mark.parametrize("joint", range(3))
def test_drift_monitor_slipped_encoder_warns_of_ball_position(joint: int) -> None:
    series, profile, plant = shipped()
    counts, watch = plant.encoders.counts_per_revolution, DriftMonitor()
    for _ in range(NEEDED + 1):
        assert swung(watch, series, profile, counts) == ()
    for part in range(1, 11):  # it crept in, so that no sample jumps
        zeros = list(plant.encoders.zero_count)
        zeros[joint] += part / 10 * 0.02 * counts / (2.0 * np.pi)
        a, b, c = zeros
        slipped = replace(plant.encoders, zero_count=(a, b, c))
        series._engine.stepper.plant = build_plant(replace(plant, encoders=slipped))
        series.rest()
    found = swung(watch, series, profile, counts)
    assert any("the head met the ball" in text for text in found)


@pytest.fixture
def swing(make_swing: Callable[[int], Cycles]) -> Cycles:
    return make_swing(3)


def test_time_at_ball_half_rate_record_gives_same_time(robot: RobotParameters, swing: Cycles) -> None:
    """Between cycles the cubic through angles and velocities is the motion."""
    fine, coarse = (time_at_ball(robot, swing[::every], BALL_X) for every in (1, 2))
    assert fine is not None
    assert 1.180 < fine < 1.190
    assert coarse == pytest.approx(fine, abs=5e-5)


@pytest.mark.parametrize("early", np.linspace(0.0, 0.9e-4, 7))
def test_time_at_ball_impact_velocity_jump_keeps_time(
    robot: RobotParameters, swing: Cycles, early: float
) -> None:
    """The impact is a jump of the velocities up to 4 mm before the ball's position; angles have none."""
    struck = swing.copy()
    before = time_at_ball(robot, swing, BALL_X)
    assert before is not None
    since = struck["time"] - (before - early)
    after = since > 0
    jump = np.array([0.5, 1.0, 12.0])
    for name in ("velocity", "plant_velocity"):
        struck[name][after] -= jump
    for name in ("angle", "plant_angle"):
        struck[name][after] -= since[after, None] * jump
    assert time_at_ball(robot, struck, BALL_X) == pytest.approx(before, abs=5e-5)


def test_time_at_ball_without_plant_values_uses_estimates(robot: RobotParameters, swing: Cycles) -> None:
    simulated = time_at_ball(robot, swing, BALL_X)
    for name in ("plant_angle", "plant_velocity"):
        swing[name] = np.nan
    assert time_at_ball(robot, swing, BALL_X) == simulated
    swing["plant_angle"] = swing["angle"] + 0.01
    swing["plant_velocity"] = swing["velocity"]
    assert time_at_ball(robot, swing, BALL_X) != simulated
    assert time_at_ball(robot, swing, BALL_X, estimated=True) == simulated


def test_time_at_ball_swing_short_of_ball_returns_none(robot: RobotParameters, swing: Cycles) -> None:
    assert time_at_ball(robot, swing[swing["time"] < 1.15], BALL_X) is None
    assert time_at_ball(robot, swing[swing["phase"] == Phase.HOLD], BALL_X) is None
    assert time_at_ball(robot, swing[:0], BALL_X) is None
