"""Without friction and actuators the robot swings for ever: its energy is constant.

The energy is computed here from the five bodies themselves (their positions in the fixed frame, their
velocities by a complex step), not from the mass matrix under test.
"""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim.kane import forward_dynamics
from sim.robot import Body, Club, RobotParameters, thesis_robot
from tests.sampling import release_except

SECONDS = 10.0
TOLERANCE = 1e-8

# All start at rest or nearly so; the regular equations hold at every theta2, so it may leave its quadrant.
STARTS = {
    "bent arm released": ((-0.4, 4.0, 5.5), (0.0, 0.0, 0.0)),
    "small swing about hanging": ((-1.5, 6.2, 6.2), (0.0, 0.0, 0.0)),
    "thrown over the top": ((-1.2, 4.2, 5.8), (6.0, -2.0, 9.0)),
}


def _bodies(robot: RobotParameters, q: Any) -> tuple[list[Any], list[Any]]:
    """Centres of mass and the unit vector along each body; analytic in q, so q may be complex."""
    link, arm, club = (np.array([np.cos(a), np.sin(a)]) for a in np.cumsum(q))
    r2, r6 = robot.l12 * link, -robot.l16 * link
    r3 = r2 + robot.l23 * arm
    across = r6 - r3
    rod = across / np.sqrt(across @ across)
    axes = [link, arm, club, rod, -rod]
    parts: tuple[Body | Club, ...] = (
        robot.shoulder_link,
        robot.left_arm,
        robot.club,
        robot.rod,
        robot.cylinder,
    )
    starts = (np.zeros(2), r2, r3, r3, r6)
    return [s + p.centre_of_mass * a for s, p, a in zip(starts, parts, axes, strict=True)], axes


def _energy(robot: RobotParameters, q: Any, u: Any) -> tuple[float, float]:
    """Kinetic and potential energy (J)."""
    parts: tuple[Body | Club, ...] = (
        robot.shoulder_link,
        robot.left_arm,
        robot.club,
        robot.rod,
        robot.cylinder,
    )
    step = 1e-30
    centres, axes = _bodies(robot, q + 1j * step * u)
    kinetic = potential = 0.0
    for part, centre, axis in zip(parts, centres, axes, strict=True):
        velocity, turning = centre.imag / step, axis.imag / step
        spin = axis.real[0] * turning[1] - axis.real[1] * turning[0]
        kinetic += (part.mass * velocity @ velocity + part.inertia * spin**2) / 2
        potential += part.mass * robot.in_plane_gravity * centre.real[1]
    return kinetic, potential


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("club", release_except({"driver"}, ("thesis", "driver")))
def test_forward_dynamics_free_swing_conserves_energy(start: str, club: str) -> None:
    robot = thesis_robot(getattr(Club, club)())
    q, u = STARTS[start]
    no_effort = np.zeros(3)

    def rate(_: float, state: Any) -> Any:
        return np.concatenate([state[3:], forward_dynamics(robot, state[:3], state[3:], no_effort)])

    motion = solve_ivp(
        rate,
        (0.0, SECONDS),
        [*q, *u],
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
        t_eval=np.linspace(0.0, SECONDS, 501),
    )
    assert motion.success
    energies = np.array([_energy(robot, state[:3], state[3:]) for state in motion.y.T])
    total, most_kinetic = energies.sum(axis=1), energies[:, 0].max()
    assert most_kinetic > 0.02, "nothing swings"
    assert np.max(np.abs(total - total[0])) < TOLERANCE * most_kinetic


def test_forward_dynamics_effort_power_equals_energy_rate() -> None:
    """dE/dt = M_A u1 + F_E dl46/dt + M_C u3 at random states: signs and directions of the efforts."""
    robot = thesis_robot()
    rng = np.random.default_rng(5)
    for _ in range(50):
        q = rng.uniform((-pi, pi + 0.1, pi), (pi, 1.6 * pi, 2 * pi))
        u, effort = rng.uniform(-5, 5, 3), rng.uniform(-1, 1, 3) * (100, 500, 50)
        u_dot = forward_dynamics(robot, q, u, effort)
        h = 1e-6

        def energy(t: float, q: Any = q, u: Any = u, u_dot: Any = u_dot) -> float:
            return sum(_energy(robot, q + t * u + t * t / 2 * u_dot, u + t * u_dot))

        def right_arm(t: float, q: Any = q, u: Any = u) -> float:
            theta2 = q[1] + t * u[1]
            return float(np.hypot(robot.l62 + robot.l23 * np.cos(theta2), robot.l23 * np.sin(theta2)))

        power = effort[0] * u[0] + effort[1] * (right_arm(h) - right_arm(-h)) / (2 * h) + effort[2] * u[2]
        assert (energy(h) - energy(-h)) / (2 * h) == pytest.approx(power, rel=1e-5, abs=1e-4)
