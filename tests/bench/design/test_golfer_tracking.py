"""Demands that follow a motion: a golfer's, or that of another swing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bench.commands.cli import app
from bench.design.designer import top_pose
from bench.design.golfer_tracking import demand_near
from bench.design.optimal_control import SwingDemand
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.plant import PlantParameters


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
