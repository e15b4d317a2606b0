"""The model derived a second time, with Lagrange's equations, from nothing but positions and angles.

Where Kane's equations in `sim.kane` sum partial velocities in the turning frame 1, this takes the five
centres of mass and orientations in the fixed frame as functions of q, lets sympy form T and V, and reads
M and h off d/dt(dT/du) - dT/dq + dV/dq = Q. The right arm closes the loop by its end points R3 and R6.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import Any

import numpy as np
import pytest

from sim.kane import bias_forces, forward_dynamics, mass_matrix
from sim.robot import Club, RobotParameters, thesis_robot

TOLERANCE = 1e-10
STATES = 500

Equations = Callable[[Any, Any, Any], tuple[Any, Any, Any]]


def _derive() -> Equations:
    """Return a function (q, u, parameters) -> mass matrix, bias forces, d l46/d q."""
    import sympy as sp  # takes a second, which collecting the tests is not to take

    q, u = sp.Matrix(sp.symbols("q1:4")), sp.Matrix(sp.symbols("u1:4"))
    l12, l16, l23, gravity = sp.symbols("l12 l16 l23 g")
    mass, inertia, distance = sp.symbols("m_a:e"), sp.symbols("i_a:e"), sp.symbols("s_a:e")

    def ray(length: Any, direction: Any) -> Any:
        return length * sp.Matrix([sp.cos(direction), sp.sin(direction)])

    link, arm, club = q[0], q[0] + q[1], q[0] + q[1] + q[2]
    r2, r6 = ray(l12, link), ray(-l16, link)
    r3 = r2 + ray(l23, arm)
    l46 = sp.sqrt((r6 - r3).dot(r6 - r3))
    towards_r6 = (r6 - r3) / l46
    right_arm = sp.atan2(towards_r6[1], towards_r6[0])

    centres = (
        ray(distance[0], link),
        r2 + ray(distance[1], arm),
        r3 + ray(distance[2], club),
        r3 + distance[3] * towards_r6,
        r6 - distance[4] * towards_r6,
    )
    angles = (link, arm, club, right_arm, right_arm)
    kinetic, potential = sp.Integer(0), sp.Integer(0)
    for m, i, centre, turned in zip(mass, inertia, centres, angles, strict=True):
        velocity = centre.jacobian(q) * u
        spin = (sp.Matrix([turned]).jacobian(q) * u)[0]
        kinetic += (m * velocity.dot(velocity) + i * spin**2) / 2
        potential += m * gravity * centre[1]

    momentum = sp.Matrix([kinetic]).jacobian(u)
    matrix = momentum.jacobian(u)
    bias = momentum.jacobian(q) * u - sp.Matrix([kinetic - potential]).jacobian(q).T
    slope = sp.Matrix([l46]).jacobian(q)
    parameters = (l12, l16, l23, gravity, *mass, *inertia, *distance)
    function: Equations = sp.lambdify([tuple(q), tuple(u), parameters], (matrix, bias, slope), cse=True)
    return function


def _parameters(robot: RobotParameters) -> tuple[float, ...]:
    bodies = (robot.shoulder_link, robot.left_arm, robot.club, robot.rod, robot.cylinder)
    return (
        robot.l12,
        robot.l16,
        robot.l23,
        robot.in_plane_gravity,
        *(body.mass for body in bodies),
        *(body.inertia for body in bodies),
        *(body.centre_of_mass for body in bodies),
    )


@pytest.fixture(scope="module")
def lagrange() -> Equations:
    return _derive()


@pytest.mark.slow
@pytest.mark.parametrize("club", [Club.thesis(), Club.driver()], ids=lambda club: club.name)
def test_kane_equals_lagrange(lagrange: Equations, club: Club) -> None:
    robot = thesis_robot(club)
    parameters = _parameters(robot)
    rng = np.random.default_rng(20100002)
    worst = dict.fromkeys(("mass matrix", "bias forces", "accelerations"), 0.0)
    for _ in range(STATES):
        q = rng.uniform((-pi, pi, -pi), (pi, 2 * pi, 3 * pi))
        u = rng.uniform(-40, 40, 3)
        effort = rng.uniform(-1, 1, 3) * (500, 3000, 300)
        matrix, bias, slope = (np.asarray(part, dtype=float) for part in lagrange(q, u, parameters))
        # M_A works on theta1, F_E on l46, M_C on theta3: the powers are M_A u1 + F_E dl46/dt + M_C u3.
        force = effort[0] * np.eye(3)[0] + effort[1] * slope.ravel() + effort[2] * np.eye(3)[2]
        acceleration = np.linalg.solve(matrix, force - bias.ravel())
        for name, found, expected in (
            ("mass matrix", mass_matrix(robot, q), matrix),
            ("bias forces", bias_forces(robot, q, u), bias.ravel()),
            ("accelerations", forward_dynamics(robot, q, u, effort), acceleration),
        ):
            error = float(np.max(np.abs(found - expected)) / np.max(np.abs(expected)))
            worst[name] = max(worst[name], error)
    assert max(worst.values()) < TOLERANCE, worst
