"""A slow swing that every machine can do, for tests of profiles and of what refuses them."""

from __future__ import annotations

import numpy as np
import pytest

from bench.control.settings import EnvelopeSettings
from bench.swing.profile import Profile
from sim.kinematics import forward_kinematics, inverse_kinematics
from sim.plant import PlantParameters


@pytest.fixture(scope="session")
def plant() -> PlantParameters:
    return PlantParameters()


@pytest.fixture(scope="session")
def envelope() -> EnvelopeSettings:
    return EnvelopeSettings()


@pytest.fixture(scope="session")
def slow_swing(plant: PlantParameters) -> Profile:
    """The shoulder alone turns by 0.5 rad in two seconds, smoothly, with the face at the ball halfway."""
    site, n = plant.site, 2000
    face = (site.ball_x - plant.ball.radius, site.ball_y, 3.5 * np.pi)
    at_ball = inverse_kinematics(plant.robot, face)
    assert forward_kinematics(plant.robot, at_ball) == pytest.approx(face)
    part = np.arange(n) / n
    turn = 0.5 * (part**3 * (10 - 15 * part + 6 * part**2) - 0.5)
    angle, velocity = np.tile(at_ball, (n, 1)), np.zeros((n, 3))
    angle[:, 0] += turn
    velocity[:, 0] = 0.5 * 30 * part**2 * (1 - part) ** 2 / (n * plant.tick)
    return Profile(
        name="slow",
        text='for tests, "quoted" and \\ back',
        golfer="nobody",
        club=plant.robot.club.name,
        period=plant.tick,
        begins=(0, 1, 400, 500, 900, 997, 1005),
        angle=angle,
        velocity=velocity,
        valve=np.zeros((n, 3)),
        blind_spacing=100,
        blind_brake=np.tile([0.1, -0.2, 0.3, 0.05, 0.0, 0.1], (20, 1)),
        ball=(site.ball_x, site.ball_y),
        impact_time=1.0,
        delivery={"head_speed_mps": 0.7},
        limits={"supply_pressure_pa": plant.supply.pressure},
    )
