from __future__ import annotations

import numpy as np
import pytest

from drivers.base.compiled import new_record
from drivers.base.records import COMMAND
from sim.kinematics import inverse_kinematics
from sim.plant import Plant, PlantParameters, advance, build_plant, initial_state


@pytest.fixture(scope="module")
def plant() -> Plant:
    return build_plant(PlantParameters())


def _turn(plant: Plant, turned: float, speed: float) -> tuple[float, np.ndarray]:
    """Turn the club for 40 ms from `turned` (rad) off the ball, half in the shoulder, half in the wrist.

    Returns the angle at the end, relative to the shaft straight down at the ball, and the plant's state.
    """
    site = plant.parameters.site
    at_ball = inverse_kinematics(plant.parameters.robot, [site.ball_x, site.ball_y, 3.5 * np.pi])
    state = initial_state(plant, at_ball + [turned / 2, 0.0, turned / 2])
    state["ball_present"] = True
    state["speed"] = [speed / 2, 0.0, speed / 2]
    command = new_record(COMMAND)
    for _ in range(40):
        advance(*plant.records, state, command)
    return float(state["angle"][0].sum()) - 3.5 * np.pi, state


def test_plant_club_reaching_ball_strikes(plant: Plant) -> None:
    _, state = _turn(plant, -0.2, 20.0)
    assert state["struck"][0]
    assert not state["ball_present"][0]
    assert state["ball_velocity"][0, 0] > 10


def test_plant_face_plane_beyond_face_misses_ball(plant: Plant) -> None:
    """In the backswing the club turns by half a turn, and the plane of its face sweeps over the ball."""
    turned, state = _turn(plant, -1.8, -50.0)
    assert turned < -3.0
    assert not state["struck"][0]
    assert state["ball_present"][0]
