"""Kane's equations against the 40 reference cases, their inverse, batches and the mass matrix' shape."""

from __future__ import annotations

import json
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.kane import bias_forces, forward_dynamics, inverse_dynamics, mass_matrix
from sim.kinematics import forward_kinematics, right_arm_length
from sim.robot import Club, thesis_robot

REFERENCE = Path(__file__).parent / "data" / "dynamics_cases.json"
CASES: list[dict[str, Any]] = json.loads(REFERENCE.read_text())["cases"]
TOLERANCE = 1e-10
CLUBS = {"thesis": Club.thesis(), "driver": Club.driver()}

angle = st.floats(-2 * pi, 2 * pi)
arm_angle = st.floats(pi + 0.1, 2 * pi - 0.1)
speed = st.floats(-40.0, 40.0)
clubs = st.sampled_from(list(CLUBS))


def random_states(n: int, seed: int = 1) -> tuple[Any, Any, Any]:
    """Random (q, u, effort), each (n, 3): the arm's whole range, any shoulder and wrist angle."""
    rng = np.random.default_rng(seed)
    q = rng.uniform((-pi, pi + 0.1, -pi), (pi, 2 * pi - 0.1, 3 * pi), (n, 3))
    return q, rng.uniform(-30, 30, (n, 3)), rng.uniform(-1, 1, (n, 3)) * (400, 2000, 200)


def test_kane_matches_reference_in_every_component() -> None:
    """Component by component, so that a large component hides no error in a small one."""
    robot = thesis_robot()
    assert len(CASES) == 40
    columns = {key: np.array([case[key] for case in CASES]) for key in CASES[0]}
    q, u, effort = (columns[name] for name in ("q", "u", "effort"))
    np.testing.assert_allclose(forward_dynamics(robot, q, u, effort), columns["qdd"], rtol=TOLERANCE)
    np.testing.assert_allclose(mass_matrix(robot, q), columns["mass_matrix"], rtol=TOLERANCE)
    np.testing.assert_allclose(forward_kinematics(robot, q), columns["head"], rtol=TOLERANCE)
    for number, back in enumerate(inverse_dynamics(robot, q, u, columns["qdd"])):
        assert np.max(np.abs(back - effort[number])) < TOLERANCE * np.max(np.abs(effort[number])), number


@given(
    q=st.tuples(angle, arm_angle, angle),
    u=st.tuples(speed, speed, speed),
    effort=st.tuples(st.floats(-400, 400), st.floats(-3000, 3000), st.floats(-300, 300)),
    club=clubs,
)
def test_inverse_dynamics_recovers_effort(
    q: tuple[float, ...], u: tuple[float, ...], effort: tuple[float, ...], club: str
) -> None:
    robot = thesis_robot(CLUBS[club])
    found = inverse_dynamics(robot, q, u, forward_dynamics(robot, q, u, effort))
    # The effort is a difference of inertia forces that may be far larger than itself.
    scale = np.max(np.abs(bias_forces(robot, q, u))) + np.max(np.abs(effort)) + 1.0
    lever = robot.l62 * robot.l23 * abs(np.sin(q[1])) / (robot.l62 + robot.l23)
    assert np.max(np.abs(found - effort)) < TOLERANCE * scale / min(1.0, lever)


@given(q=st.tuples(angle, angle, angle), club=clubs)
def test_mass_matrix_is_symmetric_and_positive_definite(q: tuple[float, ...], club: str) -> None:
    matrix = mass_matrix(thesis_robot(CLUBS[club]), q)
    assert np.array_equal(matrix, matrix.T)
    assert np.min(np.linalg.eigvalsh(matrix)) > 1e-3


@pytest.mark.parametrize("shape", [(5,), (2, 3), (0,), (1, 1)])
def test_kane_batches_equal_single_calls(shape: tuple[int, ...]) -> None:
    robot = thesis_robot()
    n = int(np.prod(shape))
    q, u, effort = random_states(n)
    batch = [rows.reshape(*shape, 3) for rows in (q, u, effort)]
    u_dot = forward_dynamics(robot, *batch)
    assert u_dot.shape == (*shape, 3)
    matrix = mass_matrix(robot, batch[0])
    assert matrix.shape == (*shape, 3, 3)
    bias = bias_forces(robot, *batch[:2])
    back = inverse_dynamics(robot, batch[0], batch[1], u_dot)
    for i, index in enumerate(np.ndindex(*shape)):
        assert np.array_equal(u_dot[index], forward_dynamics(robot, q[i], u[i], effort[i]))
        assert np.array_equal(matrix[index], mass_matrix(robot, q[i]))
        assert np.array_equal(bias[index], bias_forces(robot, q[i], u[i]))
        assert np.array_equal(back[index], inverse_dynamics(robot, q[i], u[i], u_dot[index]))


def test_forward_dynamics_equals_mass_matrix_and_bias_solution() -> None:
    robot = thesis_robot()
    q, u, effort = random_states(200)
    l46 = right_arm_length(robot, q[:, 1])
    lever = -robot.l62 * robot.l23 * np.sin(q[:, 1]) / l46
    force = effort * np.stack([np.ones(200), lever, np.ones(200)], axis=1) - bias_forces(robot, q, u)
    expected = np.linalg.solve(mass_matrix(robot, q), force[..., None])[..., 0]
    np.testing.assert_allclose(forward_dynamics(robot, q, u, effort), expected, rtol=1e-9, atol=1e-9)


def test_inverse_dynamics_at_dead_centre_gives_non_finite_arm_effort() -> None:
    """The shoulder and wrist efforts are still right; F_E is not finite, and nothing warns or raises."""
    robot = thesis_robot()
    q, u = (0.3, 0.0, 5.0), (1.0, 2.0, 3.0)
    u_dot = forward_dynamics(robot, q, u, (10.0, 0.0, 5.0)) + np.array([0.0, 1.0, 0.0])
    effort = inverse_dynamics(robot, q, u, u_dot)
    assert np.isfinite(effort[[0, 2]]).all()
    assert not np.isfinite(effort[1])


@pytest.mark.parametrize("bad", [(1.0, 2.0), 1.0, np.zeros((3, 2))])
def test_forward_dynamics_wrong_shape_raises(bad: Any) -> None:
    with pytest.raises(ValueError, match=r"expected 3|could not be broadcast|shape mismatch"):
        forward_dynamics(thesis_robot(), bad, bad, bad)


def test_forward_dynamics_nan_input_gives_nan() -> None:
    assert np.isnan(forward_dynamics(thesis_robot(), (0.0, 4.0, np.nan), np.zeros(3), np.zeros(3))).all()
