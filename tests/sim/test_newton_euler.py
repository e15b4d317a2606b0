"""The model a second time: five free bodies, held together by constraint forces (Newton and Euler).

Each body has its own three equations m a = sum of forces, I alpha = sum of torques. Pins at R1, R2, R3
(club and rod both), R6 and the cylinder's sliding guide give 12 constraint rows J on the 15 velocities;
the three actuators pull on the bodies they really sit between. Nothing is shared with `sim.kane`.
"""

from __future__ import annotations

from math import pi
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from sim.kane import forward_dynamics, inverse_dynamics
from sim.robot import Body, Club, RobotParameters, thesis_robot
from tests.sampling import release_except

Array = NDArray[np.float64]
TOLERANCE = 1e-10
STATES = 300
A, B, C, D, E = range(5)
PINS = ((None, A, "r1"), (A, B, "r2"), (B, C, "r3"), (B, D, "r3"), (A, E, "r6"))
NEXT_OF = {0: (A,), 1: (B, A), 2: (C, B)}
"""Joint speed i is the turning rate of the first body, less that of the second."""


class Mechanism(NamedTuple):
    """The bodies at one instant, all in the fixed frame."""

    mass: Array  # (15, 15)
    gravity: Array  # (15,)
    constraints: Array  # (12, 15): J v = 0
    joints: Array  # (3, 15): u = joints v
    actuators: Array  # (15, 3): generalised forces of a unit M_A, F_E, M_C
    centripetal: Array  # (12,): J a = centripetal
    velocity: Array  # (15,)
    centres: Array  # (15,), without the bodies' angles

    @property
    def energy(self) -> Array:
        """Kinetic and potential energy (J)."""
        return np.array([self.velocity @ self.mass @ self.velocity / 2, -self.gravity @ self.centres])


def _turned(vector: Array) -> Array:
    return np.array([-vector[1], vector[0]])


def _assemble(robot: RobotParameters, q: Array, u: Array) -> Mechanism:
    parts: tuple[Body | Club, ...] = (
        robot.shoulder_link,
        robot.left_arm,
        robot.club,
        robot.rod,
        robot.cylinder,
    )

    def ray(angle: float) -> Array:
        return np.array([np.cos(angle), np.sin(angle)])

    link, arm, club = (ray(angle) for angle in np.cumsum(q))
    point = {"r1": np.zeros(2), "r2": robot.l12 * link, "r6": -robot.l16 * link}
    point["r3"] = point["r2"] + robot.l23 * arm
    rod = (point["r6"] - point["r3"]) / np.linalg.norm(point["r6"] - point["r3"])
    start = (point["r1"], point["r2"], point["r3"], point["r3"], point["r6"])
    axis = (link, arm, club, rod, -rod)
    centre = [s + body.centre_of_mass * a for s, body, a in zip(start, parts, axis, strict=True)]

    rows = np.zeros((12, 15))
    for k, (first, second, name) in enumerate(PINS):
        for body, sign in ((first, 1.0), (second, -1.0)):
            if body is not None:
                rows[2 * k : 2 * k + 2, 3 * body : 3 * body + 2] = sign * np.eye(2)
                rows[2 * k : 2 * k + 2, 3 * body + 2] = sign * _turned(point[name] - centre[body])
    # The guide: rod and cylinder stay parallel, and the rod's centre on the cylinder's axis.
    rows[10, [3 * D + 2, 3 * E + 2]] = 1.0, -1.0
    across, apart = _turned(rod), centre[D] - centre[E]
    rows[11, 3 * D : 3 * D + 2], rows[11, 3 * E : 3 * E + 2] = across, -across
    rows[11, 3 * E + 2] = -rod @ apart  # d(across)/dt = -omega rod

    joints = np.zeros((3, 15))
    for i, bodies in NEXT_OF.items():
        for body, sign in zip(bodies, (1.0, -1.0), strict=False):
            joints[i, 3 * body + 2] = sign
    velocity = np.linalg.solve(np.vstack([joints, rows]), np.concatenate([u, np.zeros(12)]))

    centripetal = np.zeros(12)
    for k, (first, second, name) in enumerate(PINS):
        for body, sign in ((first, 1.0), (second, -1.0)):
            if body is not None:
                spin = velocity[3 * body + 2]
                centripetal[2 * k : 2 * k + 2] += sign * spin**2 * (point[name] - centre[body])
    spin = velocity[3 * E + 2]
    sliding = velocity[3 * D : 3 * D + 2] - velocity[3 * E : 3 * E + 2]
    centripetal[11] = 2 * spin * (rod @ sliding) + spin**2 * (across @ apart)

    actuators = np.zeros((15, 3))
    actuators[3 * A + 2, 0] = 1.0  # the vane's housing is the frame
    actuators[3 * D : 3 * D + 2, 1] = -rod  # pushes R3 away from R6
    actuators[3 * E : 3 * E + 2, 1] = rod
    actuators[3 * C + 2, 2], actuators[3 * B + 2, 2] = 1.0, -1.0  # the reaction is on the left arm

    mass = np.concatenate([[body.mass, body.mass, body.inertia] for body in parts])
    weight = np.concatenate([[0.0, -body.mass * robot.in_plane_gravity, 0.0] for body in parts])
    centres = np.concatenate([[*place, 0.0] for place in centre])
    return Mechanism(np.diag(mass), weight, rows, joints, actuators, centripetal, velocity, centres)


def _forward(robot: RobotParameters, q: Array, u: Array, effort: Array) -> Array:
    """Accelerations and constraint forces together: [M J'; J 0] [a; -force] = [f; centripetal]."""
    m = _assemble(robot, q, u)
    system = np.block([[m.mass, m.constraints.T], [m.constraints, np.zeros((12, 12))]])
    right = np.concatenate([m.gravity + m.actuators @ effort, m.centripetal])
    return np.asarray(m.joints @ np.linalg.solve(system, right)[:15])


def _inverse(robot: RobotParameters, q: Array, u: Array, u_dot: Array) -> Array:
    """Every body's acceleration from the joints', then 15 balances for 12 reactions and 3 efforts."""
    m = _assemble(robot, q, u)
    acceleration = np.linalg.solve(
        np.vstack([m.joints, m.constraints]), np.concatenate([u_dot, m.centripetal])
    )
    unknown = np.hstack([m.actuators, m.constraints.T])
    return np.asarray(np.linalg.solve(unknown, m.mass @ acceleration - m.gravity)[:3])


@pytest.mark.parametrize("club", [Club.thesis(), Club.driver()], ids=lambda club: club.name)
def test_kane_equals_newton_and_euler(club: Club) -> None:
    robot = thesis_robot(club)
    rng = np.random.default_rng(2)
    for _ in range(STATES):
        q = rng.uniform((-pi, pi + 0.1, -pi), (pi, 2 * pi - 0.1, 3 * pi))
        u = rng.uniform(-40, 40, 3)
        effort = rng.uniform(-1, 1, 3) * (500, 3000, 300)
        u_dot = _forward(robot, q, u, effort)
        found = forward_dynamics(robot, q, u, effort)
        assert np.max(np.abs(found - u_dot)) < TOLERANCE * np.max(np.abs(u_dot))

        wanted = rng.uniform(-800, 800, 3)
        needed = _inverse(robot, q, u, wanted)
        found = inverse_dynamics(robot, q, u, wanted)
        assert np.max(np.abs(found - needed)) < TOLERANCE * np.max(np.abs(needed))


def test_kane_round_trip_with_newton_euler_recovers_effort() -> None:
    robot = thesis_robot()
    q, u, effort = np.array([-1.0, 4.0, 5.5]), np.array([-9.0, 3.0, 12.0]), np.array([200.0, 900.0, 60.0])
    there = _inverse(robot, q, u, forward_dynamics(robot, q, u, effort))
    back = inverse_dynamics(robot, q, u, _forward(robot, q, u, effort))
    np.testing.assert_allclose(there, effort, rtol=TOLERANCE)
    np.testing.assert_allclose(back, effort, rtol=TOLERANCE)


STARTS = {
    "bent arm released": ((-0.4, 4.0, 5.5), (0.0, 0.0, 0.0)),
    "small swing about hanging": ((-1.5, 6.2, 6.2), (0.0, 0.0, 0.0)),
    "thrown over the top": ((-1.2, 4.2, 5.8), (6.0, -2.0, 9.0)),
}


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("club", release_except({"driver"}, ("thesis", "driver")))
def test_forward_dynamics_free_swing_conserves_energy(start: str, club: str) -> None:
    """Without friction and actuators the robot swings for ever, 10 s here."""
    robot, no_effort = thesis_robot(getattr(Club, club)()), np.zeros(3)

    def rate(_: float, state: Any) -> Any:
        return np.concatenate([state[3:], forward_dynamics(robot, state[:3], state[3:], no_effort)])

    times, begin = np.linspace(0.0, 10.0, 501), np.ravel(STARTS[start])
    motion = solve_ivp(rate, (0.0, 10.0), begin, "DOP853", times, rtol=1e-12, atol=1e-12)
    energies = np.array([_assemble(robot, state[:3], state[3:]).energy for state in motion.y.T])
    total, most_kinetic = energies.sum(axis=1), energies[:, 0].max()
    assert most_kinetic > 0.02, "nothing swings"
    assert np.max(np.abs(total - total[0])) < 1e-8 * most_kinetic
