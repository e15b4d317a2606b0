"""The compliant contact: known limits, gear effect, wet faces; conservation: `test_impact`."""

from __future__ import annotations

from dataclasses import replace
from math import cos, degrees, pi, radians, sin, sqrt, tan
from typing import Any

import numba
import numpy as np
import pytest

from sim._contact import contact_impulse
from sim.ball import Ball
from sim.impact import strike
from sim.robot import Club
from tests.sim.deliveries import delivery_from_angles

BALL = Ball()
RPM = pi / 30
MPH = 0.44704
DRIVER = replace(
    Club.driver(),
    restitution=0.882,
    restitution_slope=-0.0007,
    tangential_stiffness=1.147,
    tangential_loss=0.34,
)
IRON = replace(
    DRIVER,
    head_mass=0.268,
    restitution=0.786,
    tangential_stiffness=0.667,
    head_inertia_horizontal=2.6e-4,
    head_inertia_vertical=0.6e-4,
    head_depth=0.008,
    bulge_radius=1e6,
    roll_radius=1e6,
)
DRAWN = 20 if numba.config.DISABLE_JIT else 1000

# One mass against a wall: normal inverse mass 1, across the face 3.5 (a ball that rolls).
WALL: Any = ((1.0, 0.0, 0.0), (0.0, 3.5, 0.0), (0.0, 0.0, 3.5))


def _planar(
    slope: float, e: float = 1.0, friction: float = 1e6, stiffness: float = 1.0, loss: float = 0.0
) -> tuple[float, float]:
    """Return (normal impulse, shear impulse over that which ends the slip)."""
    impulse = contact_impulse(WALL, (1.0, slope, 0.0), (1.0, 0.0, 0.0), e, friction, stiffness, loss)
    assert impulse[2] == 0.0
    return impulse[0], impulse[1] * 3.5 / slope


@pytest.mark.parametrize("stiffness", [0.3, 2 / 3, 1.0, 1.5])
def test_contact_impulse_sticking_equals_two_oscillators(stiffness: float) -> None:
    # Half a period of the normal spring: the slip has become its cosine. Friction far above any force.
    normal, share = _planar(0.1, stiffness=stiffness)
    assert normal == pytest.approx(2.0, rel=1e-4)
    assert share == pytest.approx(1 - cos(pi * sqrt(3.5 * stiffness)), abs=2e-3)


@pytest.mark.parametrize("e", [0.3, 0.786, 0.882, 1.0])
def test_contact_impulse_normal_part_follows_restitution(e: float) -> None:
    assert _planar(0.2, e, 0.4)[0] == pytest.approx(1 + e, rel=2e-4)


def test_contact_impulse_steep_approach_slides_throughout() -> None:
    normal, share = _planar(5.0, 0.8, 0.1)
    assert share * 5.0 / 3.5 == pytest.approx(0.1 * normal, rel=1e-9)


def test_contact_impulse_tangential_loss_reduces_shear() -> None:
    assert _planar(0.1, stiffness=0.35, loss=0.4)[1] < _planar(0.1, stiffness=0.35)[1] - 0.1


def _finer(slope: float, e: float, friction: float, stiffness: float, loss: float) -> float:
    """Return the share by plain small steps, an independent reference."""
    h, c, lag = 2e-5, stiffness, loss
    x = s = shear = 0.0
    un, ut = -1.0, slope
    gain, rest, loading = 1.0, 0.0, True
    while True:
        pressure = gain * (x - rest)
        if pressure < 0.0:
            return shear * 3.5 / slope
        force = c * (s + lag * ut)
        if abs(force) > friction * pressure:
            force = friction * pressure * np.sign(force)
            s += h * (force / c - s) / lag if lag > 0.0 else force / c - s
        else:
            s += h * ut
        un += h * pressure
        ut -= h * 3.5 * force
        x -= h * un
        shear += h * force
        if loading and un >= 0.0:
            loading, gain, rest = False, 1 / e**2, x * (1 - e**2)


@pytest.mark.parametrize(
    ("loft", "e", "stiffness", "loss"),
    [(13, 0.88, 1.147, 0.34), (30, 0.786, 0.667, 0.34), (45, 0.786, 0.667, 0.0), (55, 0.786, 0.667, 0.34)],
)
def test_contact_impulse_matches_fine_step_reference(
    loft: float, e: float, stiffness: float, loss: float
) -> None:
    slope = tan(radians(loft))
    share = _planar(slope, e, 0.4, stiffness, loss)[1]
    assert share == pytest.approx(_finer(slope, e, 0.4, stiffness, loss), rel=2e-3)


def test_strike_smash_factor_stays_below_physical_limit() -> None:
    random = np.random.default_rng(21)
    for _ in range(DRAWN):
        club = DRIVER if random.random() < 0.5 else IRON
        speed, attack, loft = random.uniform(20, 60), random.uniform(-0.1, 0.1), random.uniform(0, 1.1)
        x, y = random.uniform(-0.025, 0.025), random.uniform(-0.015, 0.015)
        launch = strike(delivery_from_angles(speed, attack, 0, 0, loft, x, y), club)
        e = club.restitution - club.restitution_slope * 20
        assert launch.speed / speed <= (1 + e) / (1 + BALL.mass / club.head_mass) + 1e-9


def test_strike_gear_effect_stays_near_ideal_gear() -> None:
    # Tutelman's ideal gear: 58,830 V C x / I rpm (mph, in, in, g cm2); 25 V y up the face (rule of thumb).
    flat = replace(DRIVER, bulge_radius=1e6, roll_radius=1e6)
    for x in (-0.02, -0.01, 0.01, 0.02):
        launch = strike(delivery_from_angles(50, 0, 0, 0, 0.2, strike_x=x), flat)
        side = launch.spin * sin(launch.spin_axis) / RPM
        ideal = 58_830 * (launch.speed / MPH) * (0.035 / 0.0254) * (-x / 0.0254) / 4800
        assert 0.7 < side / ideal < 0.85

    def back(y: float) -> float:
        launch = strike(delivery_from_angles(50, 0, 0, 0, 0.2, strike_y=y), flat)
        return launch.spin * cos(launch.spin_axis) / RPM

    ideal = 25 * (strike(delivery_from_angles(50, 0, 0, 0, 0.2), flat).speed / MPH) * 0.02 / 0.0254
    assert 0.7 < (back(-0.01) - back(0.01)) / ideal < 0.95


def test_strike_half_inch_off_centre_loses_published_ball_speed() -> None:
    # Maltby: 5 % of the distance with irons, 7 % with (older) woods; here of the ball's speed.
    for club, loft, low, high in ((DRIVER, 12, 0.01, 0.07), (IRON, 23, 0.02, 0.09)):
        speeds = [
            strike(delivery_from_angles(40, 0, 0, 0, radians(loft), strike_x=x), club).speed
            for x in (0.0, 0.0127)
        ]
        assert low < 1 - speeds[1] / speeds[0] < high


def test_strike_spin_peaks_near_50_degrees_and_falls_on_wet_face() -> None:
    def spin(loft: float, club: Club) -> float:
        return strike(delivery_from_angles(35, 0, 0, 0, radians(loft)), club).spin

    lofts = range(10, 76, 2)
    dry = [spin(loft, IRON) for loft in lofts]
    assert 44 <= lofts[int(np.argmax(dry))] <= 58
    wet = replace(IRON, friction_factor=0.4)
    assert spin(12, wet) == pytest.approx(spin(12, IRON), rel=0.1)
    assert 0.35 < spin(50, wet) / spin(50, IRON) < 0.75
    high = [
        degrees(strike(delivery_from_angles(35, 0, 0, 0, radians(50)), c).launch_angle) for c in (IRON, wet)
    ]
    assert high[1] > high[0] + 3


def test_strike_restitution_follows_approach_speed() -> None:
    smooth = replace(DRIVER, head_depth=0.0, friction_factor=0.0, restitution_slope=-0.003)
    for speed in (20.0, 40.0, 60.0):
        smash = strike(delivery_from_angles(speed, 0, 0, 0, 0), smooth).speed / speed
        expected = (1.882 - 0.003 * (speed - 40)) / (1 + BALL.mass / smooth.head_mass)
        assert smash == pytest.approx(expected, rel=2e-4)
