"""The benchmark compares like with like: three simulators, one model. Needs the benchmark extras."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

pytest.importorskip("mujoco", reason="needs mujoco (pip install '.[benchmark]')")
pytest.importorskip("pinocchio", reason="needs pin (pip install '.[benchmark]')")

from sim.kane import forward_dynamics
from sim.robot import thesis_robot
from tests.benchmarks.compiled_robot import CompiledRobot
from tests.benchmarks.dynamics_speed import disagreement
from tests.benchmarks.mujoco_robot import SETTINGS, MujocoRobot
from tests.benchmarks.pinocchio_robot import PinocchioRobot

Array = NDArray[np.float64]
ROBOT = thesis_robot()
pytestmark = pytest.mark.release


def test_pinocchio_robot_accelerations_agree() -> None:
    assert disagreement(PinocchioRobot(ROBOT)) < 1e-10


@pytest.mark.parametrize("settings", SETTINGS)
def test_mujoco_robot_accelerations_agree_within_softness(settings: str) -> None:
    assert disagreement(MujocoRobot(ROBOT, settings)) < 5e-4


def test_simulators_integrate_same_motion() -> None:
    start, effort = np.array([-2.0, 3.6, 5.1]), np.array([35.0, 160.0, 15.0])

    def rate(_: float, y: Array) -> Array:
        return np.concatenate([y[3:], forward_dynamics(ROBOT, y[:3], y[3:], effort)])

    exact = solve_ivp(rate, (0.0, 0.1), [*start, 0.0, 0.0, 0.0], method="DOP853", rtol=1e-12, atol=1e-12)
    for simulator in (CompiledRobot(ROBOT), MujocoRobot(ROBOT), PinocchioRobot(ROBOT)):
        simulator.start(start, np.zeros(3))
        simulator.follow(effort[np.newaxis], 0.1 / 400, 400)
        assert np.max(np.abs(simulator.q - exact.y[:3, -1])) < 0.01, type(simulator).__name__
