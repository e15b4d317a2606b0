"""Club, tee and ball: where they meet, one impulse for both, and misses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.compiled import new_record
from drivers.base.records import COMMAND
from sim._tee import strike_ball
from sim.dynamics import STATES, head_geometry
from sim.impact import face_gap, golf_to_plane
from sim.kane import mass_matrix
from sim.kinematics import inverse_kinematics, joint_positions
from sim.plant import Plant, PlantParameters, Shaft, Site, advance, build_plant, initial_state

Array = NDArray[np.float64]
BALL = (0.25, -1.56)


def plant_with(*, flexible: bool = False, ball: tuple[float, float] = BALL, substeps: int = 4) -> Plant:
    site = Site(ball_x=ball[0], ball_y=ball[1])
    return build_plant(PlantParameters(site=site, shaft=Shaft(flexible=flexible), substeps=substeps))


def approach(plant: Plant, turned: float = -0.3) -> Any:
    """Return the robot on its way to the default ball, shoulder and wrist `turned` (rad) short of it."""
    at_ball = inverse_kinematics(plant.parameters.robot, [*BALL, 3.5 * np.pi])
    state = initial_state(plant, at_ball + [turned / 2, 0.0, turned / 2])
    state["ball_present"] = True
    state["speed"] = (12.0, 0.0, 12.0)
    return state


def run(plant: Plant, state: Any, ticks: int) -> None:
    command = new_record(COMMAND)
    command["exhaust_closed"] = True
    for _ in range(ticks):
        advance(*plant.records, state, command)


def at_contact(*, flexible: bool) -> Array:
    """Return a state vector with the face at the ball, in full swing."""
    y = np.zeros(STATES)
    y[:3] = inverse_kinematics(PlantParameters().robot, [*BALL, 3.5 * np.pi + 0.03])
    y[3:6] = (8.0, 4.0, 25.0)
    if flexible:
        y[13], y[14] = 0.02, 1.5
    return y


def face_jacobian(plant: Plant, y: Array) -> Array:
    """Return d(x, y, theta_t of the face)/d(joints, deflection), (3, 4), by differences."""
    robot, parameters, _ = plant.records
    columns = []
    for i in (0, 1, 2, 13):
        step = np.zeros(STATES)
        step[i] = 1e-6
        ahead, behind = (head_geometry(robot[0], parameters[0], y + s * step) for s in (1, -1))
        columns.append((np.array(ahead[:3]) - np.array(behind[:3])) / 2e-6)
    return np.column_stack(columns)


def masses(plant: Plant, y: Array, *, flexible: bool) -> Array:
    """Mass matrix (4, 4) of joints and deflection; the last row is unit when the shaft is rigid."""
    club = plant.parameters.robot.club
    matrix = np.eye(4)
    if not flexible:
        matrix[:3, :3] = mass_matrix(plant.parameters.robot, y[:3])
        return matrix
    bare = replace(plant.parameters.robot, club=replace(club, head_mass=1e-12))

    def head(x: Array) -> Array:
        shaft = replace(bare, club=replace(bare.club, length_to_face=club.shaft_length))
        across = np.array([-np.sin(x[:3].sum()), np.cos(x[:3].sum())])
        tip: Array = joint_positions(shaft, x[:3])[4] + x[3] * across
        return tip

    x = np.array([*y[:3], y[13]])
    jacobian = np.column_stack([(head(x + 1e-6 * e) - head(x - 1e-6 * e)) / 2e-6 for e in np.eye(4)])
    matrix = club.head_mass * jacobian.T @ jacobian
    matrix[:3, :3] += mass_matrix(bare, y[:3])
    return matrix


@pytest.mark.parametrize("flexible", [False, True])
def test_strike_ball_shares_impulse_and_gains_no_energy(flexible: bool) -> None:
    plant, y = plant_with(flexible=flexible), at_contact(flexible=flexible)
    robot, parameters, impact = plant.records
    state = initial_state(plant, y[:3])
    matrix, jacobian = masses(plant, y, flexible=flexible), face_jacobian(plant, y)
    before = y.copy()
    strike_ball(robot[0], parameters[0], impact, state[0], y)
    change = np.array([*(y[3:6] - before[3:6]), y[14] - before[14]])

    push = np.asarray(state["impulse"][0])  # on the club: x0, y0, moment
    gained = jacobian.T @ push
    if not flexible:
        gained[3] = 0.0
    assert matrix @ change == pytest.approx(gained, abs=1e-6)

    ball = plant.parameters.ball
    velocity, spin = state["ball_velocity"][0], state["ball_spin"][0]
    on_ball = golf_to_plane(tuple(ball.mass * velocity), plant.parameters.robot.lie)
    assert on_ball[:2] == pytest.approx(-push[:2], rel=1e-12)

    v0 = np.array([*before[3:6], before[14] if flexible else 0.0])
    kinetic_before = v0 @ matrix @ v0 / 2
    after = v0 + (change if flexible else np.array([*change[:3], 0.0]))
    kinetic_after = after @ matrix @ after / 2
    kinetic_after += ball.mass * velocity @ velocity / 2 + ball.inertia * spin @ spin / 2
    assert kinetic_after < kinetic_before
    assert velocity[0] > 1.2 * float(state["impact_head"][0, 3])
    assert np.array_equal(y[:3], before[:3])


@pytest.mark.parametrize("flexible", [False, True])
def test_contact_occurs_at_zero_face_gap(flexible: bool) -> None:
    plant = plant_with(flexible=flexible)
    state = approach(plant)
    run(plant, state, 60)
    assert state["struck"][0]
    assert not state["ball_present"][0]
    x, y, theta = (float(v) for v in state["impact_head"][0, :3])
    assert abs(face_gap(x, y, theta, *BALL, plant.impact)) < 1e-12
    assert 0.0 < state["impact_time"][0] < 0.06


def test_contact_time_is_independent_of_substeps() -> None:
    times = []
    for substeps in (4, 40):
        plant = plant_with(substeps=substeps)
        state = approach(plant)
        run(plant, state, 60)
        times.append(float(state["impact_time"][0]))
    assert times[0] == pytest.approx(times[1], abs=1e-7)


@pytest.mark.parametrize("height", [0.12, 0.05, -0.05])
def test_face_passing_ball_misses_and_swing_continues(height: float) -> None:
    plant = plant_with(ball=(BALL[0], BALL[1] + height))
    missed, alone = approach(plant), approach(plant)
    alone["ball_present"] = False
    run(plant, missed, 60)
    run(plant, alone, 60)
    assert not missed["struck"][0]
    assert missed["ball_present"][0]
    assert not missed["ball_velocity"].any()
    for name in ("angle", "speed", "pressure", "history"):
        assert missed[name].tobytes() == alone[name].tobytes()


def test_contact_ball_behind_face_requires_forward_motion() -> None:
    plant = plant_with()
    state = approach(plant, turned=0.1)
    x, y, theta = head_geometry(
        plant.robot[0], plant.plant[0], np.concatenate([state["angle"][0], np.zeros(15)])
    )[:3]
    assert face_gap(x, y, theta, *BALL, plant.impact) < 0.0
    run(plant, state, 5)
    state["speed"] = (-8.0, 0.0, -12.0)
    run(plant, state, 20)
    assert not state["struck"][0]
    state["speed"] = (8.0, 0.0, 12.0)
    run(plant, state, 30)
    assert state["struck"][0]


def test_tee_rising_edge_places_new_ball() -> None:
    plant = plant_with()
    state = approach(plant)
    run(plant, state, 60)
    command = new_record(COMMAND)
    command["tee"] = True
    advance(*plant.records, state, command)
    assert state["ball_present"][0]
    assert not state["struck"][0]
    state["ball_present"] = False
    advance(*plant.records, state, command)
    assert not state["ball_present"][0], "only the rising edge tees a ball up"
