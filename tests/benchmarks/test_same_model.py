"""The benchmark compares like with like: three simulators, one model. Needs the benchmark extras."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs mujoco (pip install '.[benchmark]')")
pytest.importorskip("pinocchio", reason="needs pin (pip install '.[benchmark]')")

from sim.robot import thesis_robot
from tests.benchmarks import equal_error
from tests.benchmarks.compiled_robot import CompiledRobot
from tests.benchmarks.dynamics_speed import disagreement
from tests.benchmarks.mujoco_robot import SETTINGS, MujocoRobot
from tests.benchmarks.pinocchio_robot import PinocchioRobot

ROBOT = thesis_robot()
pytestmark = pytest.mark.release


def test_pinocchio_has_the_same_accelerations() -> None:
    assert disagreement(PinocchioRobot(ROBOT, "Euler")) < 1e-10


@pytest.mark.parametrize("settings", SETTINGS)
def test_mujoco_has_the_same_accelerations_within_its_softness(settings: str) -> None:
    assert disagreement(MujocoRobot(ROBOT, "Euler", settings)) < 5e-4


@pytest.mark.parametrize("rule", ["Euler", "RK4"])
def test_all_integrate_the_same_swing(rule: str) -> None:
    end = equal_error.reference(ROBOT)
    steps, tolerance = {"Euler": (200, 0.02), "RK4": (50, 1e-4)}[rule]
    for simulator in (CompiledRobot(ROBOT, rule), MujocoRobot(ROBOT, rule), PinocchioRobot(ROBOT, rule)):
        equal_error.swing(simulator, steps)
        assert np.max(np.abs(simulator.q - end)) < tolerance, type(simulator).__name__
