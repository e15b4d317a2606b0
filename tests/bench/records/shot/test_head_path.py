from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Phase
from bench.records.shot.head_path import path_to_ball
from sim.robot import RobotParameters

Cycles = np.ndarray[Any, Any]
BALL_X = 0.2315


@pytest.fixture
def swing(make_swing: Callable[[int], Cycles]) -> Cycles:
    return make_swing(3)


def test_path_to_ball_covers_requested_distance_before_ball(robot: RobotParameters, swing: Cycles) -> None:
    path = path_to_ball(robot, swing, BALL_X, 0.1)
    assert path is not None
    x = path.position[:, 0]
    assert np.all(np.diff(x) > 0)
    assert x[0] == pytest.approx(BALL_X - 0.1, abs=2e-3)
    assert x[-1] == pytest.approx(BALL_X, abs=2e-3)
    assert 60 <= len(x) <= 100
    assert 1.180 < path.time[-1] < 1.190


def test_path_to_ball_half_rate_record_gives_same_path(robot: RobotParameters, swing: Cycles) -> None:
    """Between cycles the cubic through angles and velocities is the motion."""
    fine, coarse = (path_to_ball(robot, swing[::every], BALL_X, 0.1) for every in (1, 2))
    assert fine is not None
    assert coarse is not None
    y = np.interp(fine.position[:, 0], *coarse.position.T)
    assert np.allclose(y, fine.position[:, 1], atol=1e-4)


@pytest.mark.parametrize("early", np.linspace(0.0, 0.9e-4, 7))
def test_path_to_ball_impact_velocity_jump_keeps_path(
    robot: RobotParameters, swing: Cycles, early: float
) -> None:
    """The impact is a jump of the velocities up to 4 mm before the ball's position; angles have none."""
    struck = swing.copy()
    before = path_to_ball(robot, swing, BALL_X, 0.1)
    assert before is not None
    since = struck["time"] - (before.time[-1] - early)
    after = since > 0
    jump = np.array([0.5, 1.0, 12.0])
    for name in ("velocity", "plant_velocity"):
        struck[name][after] -= jump
    for name in ("angle", "plant_angle"):
        struck[name][after] -= since[after, None] * jump
    with_jump = path_to_ball(robot, struck, BALL_X, 0.1)
    assert with_jump is not None
    assert np.allclose(before.position, with_jump.position, atol=1e-4)


def test_path_to_ball_without_plant_values_uses_estimates(robot: RobotParameters, swing: Cycles) -> None:
    simulated = path_to_ball(robot, swing, BALL_X, 0.1)
    for name in ("plant_angle", "plant_velocity"):
        swing[name] = np.nan
    measured = path_to_ball(robot, swing, BALL_X, 0.1)
    assert simulated is not None
    assert measured is not None
    assert np.array_equal(simulated.position, measured.position)


def test_path_to_ball_swing_short_of_ball_returns_none(robot: RobotParameters, swing: Cycles) -> None:
    assert path_to_ball(robot, swing[swing["time"] < 1.15], BALL_X, 0.1) is None
    assert path_to_ball(robot, swing[swing["phase"] == Phase.HOLD], BALL_X, 0.1) is None
    assert path_to_ball(robot, swing[:0], BALL_X, 0.1) is None
