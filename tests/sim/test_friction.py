"""Dry friction of coupled joints against an independent solution by enumeration."""

from __future__ import annotations

from itertools import product
from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim.dynamics import friction_bound, friction_impulse
from sim.kane import mass_matrix
from sim.robot import thesis_robot

Array = NDArray[np.float64]
UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])


def rubbed(matrix: Array, speed: Array, bound: Array) -> Array:
    return np.array(friction_impulse(*matrix[UPPER], *speed, *bound))


def enumerated(matrix: Array, speed: Array, bound: Array) -> Array:
    """Try all 27 combinations of sticking and sliding either way; return the consistent one."""
    inverse = np.linalg.inv(matrix)
    best, least = speed, inf
    for case in product((-1, 0, 1), repeat=3):
        impulse = np.array([sign * b for sign, b in zip(case, bound, strict=True)])
        sticks = [i for i in range(3) if case[i] == 0]
        if sticks:
            block = inverse[np.ix_(sticks, sticks)]
            impulse[sticks] = np.linalg.solve(block, -(speed + inverse @ impulse)[sticks])
        after = speed + inverse @ impulse
        wrong = np.maximum(np.abs(impulse) - bound, 0.0).sum()  # more than the bound
        wrong += sum(max(sign * after[i], 0.0) for i, sign in enumerate(case) if sign and bound[i] > 0)
        if wrong < least:
            best, least = after, wrong
    assert least < 1e-9
    return best


def cases(n: int) -> list[tuple[Array, Array, Array]]:
    """Mass matrices of the robot over its range, speeds, and bounds from nothing to plenty."""
    rng = np.random.default_rng(11)
    robot = thesis_robot()
    found = []
    for _ in range(n):
        matrix = mass_matrix(robot, rng.uniform((-2, 3.3, 4.8), (2, 4.5, 6.4)))
        speed = rng.normal(0, 5, 3) * rng.integers(0, 2, 3)
        bound = rng.exponential(np.abs(matrix @ speed).max() + 0.1, 3) * rng.integers(0, 2, 3)
        found.append((matrix, speed, bound))
    return found


def test_friction_impulse_matches_complementarity_solution() -> None:
    for matrix, speed, bound in cases(200):
        after = rubbed(matrix, speed, bound)
        assert after == pytest.approx(enumerated(matrix, speed, bound), abs=1e-9)
        assert after @ matrix @ after <= (speed @ matrix @ speed) * (1 + 1e-12)


coefficient = st.floats(-1.0, 1.0)


@given(
    st.lists(coefficient, min_size=9, max_size=9),
    st.lists(st.floats(-20, 20), min_size=3, max_size=3),
    st.lists(st.floats(0, 10), min_size=3, max_size=3),
)
def test_friction_impulse_never_adds_energy(
    factor: list[float], speed: list[float], bound: list[float]
) -> None:
    root = np.array(factor).reshape(3, 3)
    matrix, u = root @ root.T + 0.05 * np.eye(3), np.array(speed)
    after = rubbed(matrix, u, np.array(bound))
    assert after @ matrix @ after <= (u @ matrix @ u) * (1 + 1e-9) + 1e-12


def test_friction_impulse_large_bound_stops_exactly() -> None:
    matrix, speed, _ = cases(1)[0]
    assert rubbed(matrix, speed + 1.0, np.full(3, 1e3)).tolist() == [0.0, 0.0, 0.0]


def test_friction_impulse_zero_bound_keeps_speed() -> None:
    matrix, _, _ = cases(1)[0]
    speed = np.array([1.0, -2.0, 3.0])
    assert rubbed(matrix, speed, np.zeros(3)).tolist() == speed.tolist()


def test_friction_impulse_fixed_joint_stays_fixed() -> None:
    matrix = cases(1)[0][0]
    after = rubbed(matrix, np.array([0.0, 0.0, 4.0]), np.array([inf, 0.0, 0.05]))
    assert after[0] == 0.0
    assert 0.0 < after[2] < 4.0
    assert after[1] != 0.0


def test_friction_bound_falls_from_static_to_coulomb() -> None:
    assert friction_bound(6.0, 8.0, 0.05, 0.0) == 8.0
    assert friction_bound(6.0, 8.0, 0.05, -0.05) == pytest.approx(6.0 + 2.0 * np.exp(-1))
    assert friction_bound(6.0, 8.0, 0.05, 10.0) == 6.0
    speeds = np.linspace(0.0, 0.5, 200)
    bounds = np.array([friction_bound(6.0, 8.0, 0.05, v) for v in speeds])
    assert np.all(np.diff(bounds) <= 0.0)
    assert np.max(np.abs(np.diff(bounds))) < 0.1  # no jump where the exponential is left out
