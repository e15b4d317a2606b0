"""Bounce and roll: never a gain of energy, limits that can be computed by hand."""

from __future__ import annotations

from math import radians

import pytest
from hypothesis import strategies as st

from sim.ground import Turf, bounce, restitution, roll, slip_velocity
from sim.vectors import Vector, dot
from tests.sampling import examples

RADIUS = 0.021335
UP = (0.0, 1.0, 0.0)

vectors = st.tuples(st.floats(-40, 40), st.floats(-40, -0.1), st.floats(-20, 20))
spins = st.tuples(st.floats(-1000, 1000), st.floats(-1000, 1000), st.floats(-1000, 1000))


def _energy(velocity: Vector, spin: Vector) -> float:
    return dot(velocity, velocity) + 0.4 * RADIUS**2 * dot(spin, spin)


@examples(60, 200, velocity=vectors, spin=spins, friction=st.floats(0, 1), tilt=st.floats(0, 0.5))
def test_bounce_never_gains_energy(velocity: Vector, spin: Vector, friction: float, tilt: float) -> None:
    after = bounce(velocity, spin, RADIUS, friction, tilt, 1.0)
    assert _energy(*after) <= _energy(velocity, spin) * (1 + 1e-12)


def test_bounce_gripping_ball_leaves_rolling() -> None:
    velocity, spin = bounce((10.0, -8.0, 1.0), (0.0, 0.0, 100.0), RADIUS, 10.0, 0.0, 1.0)
    assert slip_velocity(velocity, spin, UP, RADIUS) == pytest.approx((0, 0, 0), abs=1e-12)
    assert velocity[1] == pytest.approx(8.0 * restitution(8.0))
    assert velocity[0] == pytest.approx((5 * 10.0 - 2 * RADIUS * 100.0) / 7)  # Penner: (5 v - 2 r omega) / 7


def test_bounce_sliding_ball_follows_coulomb_friction() -> None:
    velocity, _ = bounce((10.0, -1.0, 0.0), (0.0, 0.0, 900.0), RADIUS, 0.1, 0.0, 1.0)
    assert velocity[0] == pytest.approx(10.0 - 0.1 * (1 + restitution(1.0)) * 1.0)


def test_bounce_soft_turf_steepens_rebound() -> None:
    flat = bounce((15.0, -12.0, 0.0), (0.0, 0.0, 300.0), RADIUS, 0.4, 0.0, 1.0)[0]
    soft = bounce((15.0, -12.0, 0.0), (0.0, 0.0, 300.0), RADIUS, 0.4, radians(15.4), 1.0)[0]
    assert soft[1] > flat[1]
    assert soft[0] < flat[0]


def test_restitution_matches_penner() -> None:
    assert restitution(0.0) == pytest.approx(0.51)
    assert restitution(10.0) == pytest.approx(0.510 - 0.375 + 0.0903)
    assert restitution(25.0) == pytest.approx(0.12)
    assert restitution(19.999) == pytest.approx(0.12, abs=2e-3)


def test_roll_stops_at_friction_distance() -> None:
    rolling_spin = (0.0, 0.0, -4.0 / RADIUS)
    x, z, time = roll((4.0, 0.0, 0.0), rolling_spin, RADIUS, 0.1, 9.80665)
    assert x == pytest.approx(4.0**2 / (2 * 0.1 * 9.80665))
    assert z == 0
    assert time == pytest.approx(4.0 / (0.1 * 9.80665))


def test_roll_back_spin_draws_ball_back() -> None:
    assert roll((0.5, 0.0, 0.0), (0.0, 0.0, 600.0), RADIUS, 0.131, 9.80665)[0] < 0


def test_turf_unphysical_value_raises() -> None:
    with pytest.raises(ValueError, match=r"Turf\.rolling_resistance: found 0\.0"):
        Turf(rolling_resistance=0.0)
