"""The sole on the ground: the force of a surface on the head, and the power that leaves the robot."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sim.dynamics import STATES, _derivative, head_geometry
from sim.ground import SURFACES, SurfaceName, ground_drag
from sim.kane import mass_matrix
from sim.plant import Plant, PlantParameters, Shaft, Site, build_plant
from sim.pneumatics import stop_force
from sim.robot import RobotParameters

POSE = np.array([0.2, 4.3, 6.0])
SPEEDS = ((6.0, -2.0, 18.0), (-1.0, 1.0, -0.5), (0.0, 0.0, 0.001))
DEPTH = 0.006


def plant_on(surface: SurfaceName, ground: float, *, flexible: bool = False) -> Plant:
    site = Site(ground=ground, surface=surface)
    return build_plant(replace(PlantParameters(), site=site, shaft=Shaft(flexible=flexible)))


def state_of(speed: tuple[float, float, float], flex: float, flex_speed: float) -> Any:
    y = np.zeros(STATES)
    y[:3], y[3:6], y[13], y[14] = POSE, speed, flex, flex_speed
    y[6:13] = PlantParameters().supply.atmosphere
    return y


def rates(plant: Plant, y: Any) -> Any:
    dy, terms = np.zeros(STATES), np.zeros(STATES)
    robot, parameters, _ = plant.records
    _derivative(
        robot[0], parameters[0], y, 0.0, 0.0, 0.0, 0.0, 0.0, np.ones(3), dy, terms, np.full(9, np.nan)
    )
    return dy


def head_power(plant: Plant, y: Any, change: Any) -> float:
    """Return the rate of kinetic energy (W) that a `change` of the accelerations brings."""
    robot = plant.parameters.robot
    if not plant.parameters.shaft.flexible:
        return float(y[3:6] @ mass_matrix(robot, y[:3]) @ change[3:6])
    light = replace(robot, club=replace(robot.club, head_mass=1e-9))
    arms = float(y[3:6] @ mass_matrix(light, y[:3]) @ change[3:6])
    return arms + robot.club.head_mass * float(head_motion(robot, y, y) @ head_motion(robot, y, change))


def head_motion(robot: RobotParameters, y: Any, speeds: Any) -> Any:
    """Return the motion of the flexible head's mass with the `speeds` of joints and deflection at `y`."""
    step = 1e-6
    ahead, behind = y.copy(), y.copy()
    for point, side in ((ahead, step), (behind, -step)):
        point[:3] += side * speeds[3:6]
        point[13] += side * speeds[14]
    return (head_place(robot, ahead) - head_place(robot, behind)) / (2 * step)


def head_place(robot: RobotParameters, y: Any) -> Any:
    """Return the place of the flexible head's mass (m): at the shaft's end, deflected across it."""
    a1, a2, a3 = (np.array([np.cos(a), np.sin(a)]) for a in np.cumsum(y[:3]))
    across = np.array([-a3[1], a3[0]])
    return robot.l12 * a1 + robot.l23 * a2 + robot.club.shaft_length * a3 + y[13] * across


@pytest.mark.parametrize("flexible", [False, True])
@pytest.mark.parametrize("surface", SURFACES)
def test_ground_force_power_equals_robot_power_change(surface: SurfaceName, flexible: bool) -> None:
    for speed in SPEEDS:
        flex, flex_speed = (0.02, -1.5) if flexible else (0.0, 0.0)
        y = state_of(speed, flex, flex_speed)
        far = plant_on(surface, -3.0, flexible=flexible)
        p = far.plant[0]
        head = head_geometry(far.robot[0], p, y)
        ground = float(head[1]) - p["sole_depth"] + DEPTH
        near = plant_on(surface, ground, flexible=flexible)
        change = rates(near, y) - rates(far, y)
        push = stop_force(p["ground_stiffness"], np.inf, 5.0, DEPTH, -head[4])
        along = float(head[3] + p["sole_depth"] * head[5])
        drag = ground_drag(near.plant[0], push, DEPTH, along)
        power = push * head[4] + drag * along
        assert head_power(near, y, change) == pytest.approx(power, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("surface", SURFACES)
def test_ground_drag_opposes_motion_and_grows_with_depth(surface: SurfaceName) -> None:
    p = plant_on(surface, -3.0).plant[0]
    assert ground_drag(p, 100.0, 0.005, 0.0) == 0.0
    for speed in (0.01, 1.0, 40.0):
        drag = ground_drag(p, 100.0, 0.005, speed)
        assert ground_drag(p, 100.0, 0.005, -speed) == -drag
        assert drag <= 0.0
        assert ground_drag(p, 100.0, 0.010, speed) <= drag
        assert (drag == 0.0) == (surface == "none")


def test_ground_drag_on_turf_grows_with_speed_on_mat_stays_constant() -> None:
    turf, mat = (plant_on(name, -3.0).plant[0] for name in ("turf", "mat"))
    assert ground_drag(turf, 100.0, 0.005, 40.0) < 2 * ground_drag(turf, 100.0, 0.005, 10.0)
    assert ground_drag(mat, 100.0, 0.005, 40.0) == pytest.approx(
        ground_drag(mat, 100.0, 0.005, 10.0), rel=0.01
    )


def test_ground_surface_without_contact_changes_nothing() -> None:
    y = state_of(SPEEDS[0], 0.0, 0.0)
    bare, turf = (rates(plant_on(name, -3.0), y) for name in ("none", "turf"))
    assert bare.tobytes() == turf.tobytes()
