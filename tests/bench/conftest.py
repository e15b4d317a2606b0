"""A swing made by kinematics alone, for tests of what is stored and shown."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from bench.lifecycle import Phase
from scipy.interpolate import CubicHermiteSpline

from bench.telemetry.cycle_record import CYCLE, FIELDS
from sim.kinematics import joint_positions
from sim.robot import Club, RobotParameters, thesis_robot

ADDRESS = np.array([0.571, 4.141, 2 * np.pi])
"""Shaft straight down, wrist uncocked (rad)."""

Cycles = np.ndarray[Any, Any]


@pytest.fixture(scope="session")
def robot() -> RobotParameters:
    return thesis_robot(Club.driver())


@pytest.fixture(scope="session")
def make_swing(robot: RobotParameters) -> Callable[[int], Cycles]:
    """Return a function of the seed that gives a swing of about two seconds at 1 kHz."""

    def make(seed: int = 0) -> Cycles:
        random = np.random.default_rng(seed)
        time = np.arange(2100) * 1e-3
        knots = np.array([0.0, 0.2, 0.886, 0.986, 1.186, 1.5, 2.1])
        finish = ADDRESS + [1.9, 0.35, -0.6]
        top = ADDRESS + [-1.81, -0.6, -1.39]
        points = np.array([ADDRESS, ADDRESS, top, top, ADDRESS, finish, ADDRESS])
        speeds = np.zeros((7, 3))
        speeds[4] = np.array([11.8, 4.0, 11.0]) * (1 + 0.01 * random.standard_normal())
        path = CubicHermiteSpline(knots, points, speeds)
        return _cycles(robot, time, path, random)

    return make


def _cycles(
    robot: RobotParameters, time: np.ndarray, path: CubicHermiteSpline, random: np.random.Generator
) -> Cycles:
    cycles = np.zeros(len(time), CYCLE)
    for field in FIELDS:
        if field.dtype == "f8":
            cycles[field.name] = random.standard_normal((len(time), *field.shape))
    cycles["tick"] = np.arange(len(time)) + 5000
    cycles["time"] = time
    cycles["measured_step"] = 1e-3
    starts = [0.0, 0.2, 0.886, 0.986, 1.1, 1.185, 1.19, 1.5]
    phases = [
        Phase.HOLD, Phase.BACKSWING, Phase.TOP, Phase.DOWNSWING, Phase.COMMITTED, Phase.IMPACT,
        Phase.FOLLOW_THROUGH, Phase.RETURN,
    ]  # fmt: skip
    for start, phase in zip(starts, phases, strict=True):
        cycles["phase"][time >= start] = phase
    angle, velocity = path(time), path(time, 1)
    cycles["angle"] = cycles["plant_angle"] = angle
    cycles["velocity"] = cycles["plant_velocity"] = velocity
    cycles["reference_angle"] = angle + 0.01 * np.sin(9 * time)[:, None]
    cycles["reference_velocity"] = velocity
    cycles["encoder_count"] = np.round(angle * 20000 / (2 * np.pi))
    cycles["encoder_valid"] = 1
    cycles["desired_valve"] = np.clip(velocity / 12, -1, 1)
    cycles["applied_valve"] = cycles["desired_valve"] * 0.98
    pressure = 4.5e5 + 2e5 * np.repeat(np.tanh(velocity / 8), 2, axis=1) * [1, -1, 1, -1, 1, -1]
    cycles["chamber_pressure"] = cycles["plant_pressure"] = pressure
    cycles["supply_pressure"] = 8e5
    cycles["plant_effort"] = velocity * [20, 80, 8]
    for name in ("supply_enable", "exhaust_closed", "guard_lock", "emergency_stop_clear", "guard_closed"):
        cycles[name] = True
    cycles["guard_locked"] = True
    cycles["ball_present"] = time < 1.186
    head = joint_positions(robot, angle)[:, 4]
    cycles["head_position"] = cycles["plant_head_position"] = head
    cycles["head_orientation"] = angle.sum(axis=1)
    cycles["plant_head_speed"] = np.linalg.norm(np.gradient(head, time, axis=0), axis=1)
    return cycles
