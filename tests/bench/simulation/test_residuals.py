"""Wear shows in the residuals of recorded swings before the model-based check stops one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.config import Configuration
from bench.control.estimate.residual_monitor import KINDS
from bench.records.telemetry.record_file import read_swing, write_swing
from bench.simulation.replay import NEAR, margins, residual_shares
from bench.simulation.simulated_bench import Bench, PoweredBench
from bench.supervisor.status import read_wear, wear_file
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.plant import PlantParameters, build_plant
from tests.compiled_only import needs_speed
from tests.conftest import Run


def _steady(swings: int) -> np.ndarray:
    return np.full((swings, len(KINDS), 3), 0.5)


def test_margins_growing_residual_is_near_before_limit() -> None:
    shares = _steady(120)
    shares[:, KINDS.index("flow"), 2] += 0.003 * np.arange(120)
    worst, *others = margins(shares)
    assert (worst.kind, worst.joint, worst.near) == ("flow", "wrist", True)
    assert worst.growth == pytest.approx(0.003)
    assert worst.latest < 0.9
    assert not any(one.near or one.growth for one in others)


def test_margins_trend_of_few_swings_is_not_extrapolated_to_limit() -> None:
    shares = _steady(10)
    shares[:, KINDS.index("velocity"), 2] += 0.005 * np.arange(10)  # as a robot that warms up
    worst = margins(shares)[0]
    assert (worst.kind, worst.near) == ("velocity", False)
    assert worst.growth > 0.0


def test_margins_scattering_residual_has_no_trend() -> None:
    shares = _steady(40) + np.random.default_rng(3).normal(0.0, 0.02, (40, len(KINDS), 3))
    assert sum(one.growth != 0.0 for one in margins(shares)) <= 2  # 1 of 20 by chance
    assert not any(one.near for one in margins(shares))


def test_margins_residual_close_to_limit_is_near_after_one_swing() -> None:
    shares = _steady(1)
    shares[0, 0, 0] = 0.95
    assert [one.near for one in margins(shares)] == [True] + 14 * [False]


def _worn(plant: PlantParameters, band: float) -> PlantParameters:
    valve = replace(plant.wrist.valve, dead_band=plant.wrist.valve.dead_band + band)
    return replace(plant, wrist=replace(plant.wrist, valve=valve))


@pytest.mark.slow
@needs_speed
def test_wear_command_worn_valve_names_joint_before_swing_stops(
    configuration: Configuration, tmp_path: Path, run: Run
) -> None:
    path = find_profile(configuration.swing.profile)
    profile = load_profile(path)
    c = configuration.for_profile(profile, path)
    bench = Bench.of(c, profile)
    latest = []
    for number, band in enumerate((0.0, 0.011)):
        powered = PoweredBench(bench)
        powered.engine.stepper.plant = build_plant(_worn(c.plant, band))
        assert powered.arm()
        swing = powered.swing(c.plant.ball)
        assert not swing.cause
        metadata = swing.replay_metadata() | {"time_utc": f"2026-01-0{number + 1}T00:00:00", "bench": "b1"}
        record = tmp_path / f"{number}.parquet"
        write_swing(record, swing.cycles, bench.metadata(metadata))
        latest.append(residual_shares(*read_swing(record), str(record)).max())
    assert latest[0] < 0.8
    assert NEAR <= latest[1] < 1.0
    file = tmp_path / "golfbench.toml"
    file.write_text(f'base = "shipped"\nbench = {{ id = "b1", data_dir = "{tmp_path}" }}\n')
    warned = run("--config", file, "wear", tmp_path / "1.parquet")
    assert (warned.code, "wrist flow is near its limit" in warned.words) == (1, True)
    earlier = run("--config", file, "wear", tmp_path / "0.parquet")  # an analysis of earlier swings
    assert "not stored: found swings until 2026-01-01" in earlier.words
    (finding,) = (one for one in read_wear(wear_file(tmp_path, "b1")).findings if one["part"] == "wrist flow")
    assert finding["text"].startswith("wrist flow is near its limit: ")
    assert finding["time_utc"] == "2026-01-02T00:00:00"
