"""Demands that follow a motion: a golfer's, built-in or measured, or that of another swing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bench.base.errors import BenchError
from bench.commands.cli import app
from bench.config import load_configuration
from bench.design.designer import furthest_cock, top_pose, wrist_range
from bench.design.golfer_tracking import demand_measured, demand_near
from bench.design.optimal_control import SwingDemand
from bench.golfer.comparison import beyond_ranges
from bench.golfer.golfer_file import GolferSwing
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.kinematics import right_arm_length
from sim.plant import PlantParameters
from tests.bench.golfer.synthetic import BALL, TOP, golfer_swing


def test_demand_near_takes_top_time_and_poses_of_profile() -> None:
    plant, profile = PlantParameters(), load_profile(find_profile("default"))
    demand = demand_near(plant, profile, SwingDemand(head_speed=43.2))
    begin, ball = profile.begins[3], round(profile.impact_time / profile.period)
    assert demand.follow is not None
    assert demand.ranges is not None
    assert demand.follow[0] == pytest.approx(profile.angle[begin])
    assert demand.follow[-1] == pytest.approx(profile.angle[ball], abs=0.02)
    assert top_pose(plant, demand) == pytest.approx(profile.angle[begin], abs=1e-3)
    assert demand.downswing_time[0] < profile.downswing_time < demand.downswing_time[1]
    assert np.all(demand.ranges < np.ptp(profile.angle[begin:ball], axis=0))
    assert demand.head_speed == 43.2


def test_profile_design_golfer_with_near_refused(tmp_path: Path) -> None:
    arguments = ["profile", "design", str(tmp_path / "a.toml"), "--golfer", "senior", "--near", "default"]
    result = CliRunner().invoke(app, arguments)
    assert "--golfer and --near" in str(result.exception or result.output)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def golfer() -> GolferSwing:
    return golfer_swing()


def test_demand_measured_takes_speed_attack_and_tempo(golfer: GolferSwing) -> None:
    plant = load_configuration(Path("golfers")).plant
    demand = demand_measured(plant, golfer, SwingDemand())
    assert demand.head_speed == 43.8
    assert demand.attack == pytest.approx(golfer.attack)
    assert abs(np.degrees(demand.attack)) < 8.0
    assert demand.backswing_time == pytest.approx(TOP - 0.2, abs=0.1)
    lasting = BALL - TOP
    assert demand.downswing_time[0] < lasting < demand.downswing_time[1]
    stated = demand_measured(plant, golfer, SwingDemand(), 40.0, 0.02)
    assert (stated.head_speed, stated.attack) == (40.0, 0.02)


def test_demand_measured_follows_body_with_full_wrist_range(golfer: GolferSwing) -> None:
    plant = load_configuration(Path("golfers")).plant
    cocked = golfer.angle.copy()
    cocked[:, 2] -= 0.03
    deep = replace(golfer, angle=cocked)
    demand = demand_measured(plant, deep, SwingDemand())
    assert demand.follow is not None
    assert np.isfinite(demand.follow).all()  # no run-up
    assert demand.follow[-1] == pytest.approx(np.minimum(deep.angle[-1], plant.wrist.upper))
    assert demand.top_cock is not None
    assert demand.top_cock > furthest_cock(plant)
    held_from = wrist_range(plant, demand)[0]
    assert held_from + 0.08 < top_pose(plant, demand)[2] < held_from + 0.12  # where its lever holds it
    assert top_pose(plant, demand)[0] == pytest.approx(deep.angle[deep.top_row, 0])


def test_demand_measured_top_beyond_stroke_stays_off_end_stops(golfer: GolferSwing) -> None:
    plant = load_configuration(Path("golfers")).plant
    lower, upper = plant.right_arm.lower, plant.right_arm.upper
    for turned in (-0.6, 0.9):
        beyond = replace(golfer, angle=golfer.angle + [0.0, turned, 0.0])
        assert beyond_ranges(plant, beyond.angle[golfer.top_row :])[1] > 0.0
        demand = demand_measured(plant, beyond, SwingDemand())
        assert lower + 0.01 < demand.top_extension < upper - 0.01
        assert demand.follow is not None
        rods = right_arm_length(plant.robot, demand.follow[:, 1]) - plant.robot.l56
        assert lower < rods.min() <= rods.max() <= upper + 1e-9


def test_demand_measured_without_club_raises(golfer: GolferSwing) -> None:
    body = replace(golfer, angle=golfer.angle * [1.0, 1.0, np.nan])
    with pytest.raises(BenchError, match="grip and head"):
        demand_measured(load_configuration(Path("golfers")).plant, body, SwingDemand())
