"""A swing made by kinematics alone, a slow swing that every machine can do, and a day made of states.

And pages of campaigns without the drawing of their pictures, which takes most of the time of a report.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from functools import cache
from importlib.metadata import entry_points
from math import cos, pi, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from bench.base.lifecycle import Cause, Phase, State
from bench.control.settings import EnvelopeSettings
from bench.records.shot.shot import (
    Shot,
    ShotRecord,
    ShotStatus,
    delivery_columns,
    flight_columns,
    launch_columns,
)
from bench.records.telemetry.cycle_record import CYCLE, FIELDS
from bench.swing.profile import Profile
from drivers.base import Launch
from sim.flight import fly
from sim.impact import Delivery
from sim.kinematics import forward_kinematics, inverse_kinematics, joint_positions
from sim.plant import PlantParameters
from sim.robot import Club, RobotParameters, thesis_robot

ADDRESS = np.array([0.571, 4.141, 2 * np.pi])
"""Shaft straight down, wrist uncocked (rad)."""

BALL = (0.2315, -1.514)
"""Where the ball of the synthetic swing lies in the swing plane (m)."""

Cycles = np.ndarray[Any, Any]


@pytest.fixture(scope="session", autouse=True)
def _installed_drivers() -> Iterator[None]:
    """List the installed drivers once: each check of a configuration reads all packages for them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bench.config._rules.entry_points", cache(entry_points))
        yield


@pytest.fixture
def overlay(tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that writes an overlay of the shipped configuration."""

    def write(text: str) -> Path:
        path = tmp_path / "mine.toml"
        path.write_text(f'base = "shipped"\n{text}\n', encoding="utf-8")
        return path

    return write


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


@pytest.fixture(scope="session")
def make_records(make_swing: Callable[[int], Cycles]) -> Callable[[int], list[ShotRecord]]:
    """Return a function of the number of shots that gives their records, balls alternating."""

    def make(shots: int) -> list[ShotRecord]:
        return [_record(number, make_swing(number)) for number in range(1, shots + 1)]

    return make


@pytest.fixture(scope="session")
def make_day() -> Callable[..., Cycles]:
    """Return `make(plan, first_tick, start, cause)`: `plan` holds (state, ticks); values are noise.

    `cause` (tick, cause) is latched from that tick to the end.
    """

    def make(
        plan: Sequence[tuple[State, int]],
        *,
        first_tick: int = 1,
        start: float = 1000.0,
        cause: tuple[int, Cause] | None = None,
    ) -> Cycles:
        states = np.repeat([state for state, _ in plan], [ticks for _, ticks in plan])
        random = np.random.default_rng(len(states))
        cycles = np.zeros(len(states), CYCLE)
        for field in FIELDS:
            if field.dtype == "f8":
                cycles[field.name] = random.standard_normal((len(states), *field.shape))
        cycles["tick"] = first_tick + np.arange(len(states))
        cycles["time"] = start + np.arange(len(states)) / 1024  # no rounding: a test may count ticks
        cycles["encoder_time"] = cycles["time"][:, None] - 1e-4
        cycles["measured_step"] = 1 / 1024
        cycles["state"] = states
        if cause is not None:
            cycles["cause"][cause[0] - first_tick :] = cause[1]
        return cycles

    return make


def _record(number: int, cycles: Cycles) -> ShotRecord:
    random = np.random.default_rng(number)
    ball = ("Pro V", "Range")[(number - 1) % 2]
    base: dict[str, Any] = {
        "shot": number,
        "block": (number + 1) // 2,
        "position": 2 - number % 2,
        "club": "driver",
        "ball": ball,
        "time_utc": datetime(2026, 11, 1, 9, 30, tzinfo=UTC) + number * timedelta(seconds=30),
    }
    if number == 4:
        return ShotRecord(Shot(**base, status=ShotStatus.FAILED, reason="no ball seen on the tee"), cycles)
    speed = random.normal(43.0, 0.15)
    launch = Launch(
        speed * (1.44 if ball == "Pro V" else 1.425),
        radians(random.normal(12.0, 0.2)),
        radians(random.normal(0.4, 0.3)),
        random.normal(3100.0, 60.0) * pi / 30,
        radians(random.normal(1.5, 0.8)),
    )
    flight = fly(launch)
    path, attack = random.normal(0.014, 0.001), random.normal(0.019, 0.001)
    delivery = Delivery(
        velocity=(speed * cos(path) * cos(attack), speed * sin(attack), speed * sin(path) * cos(attack)),
        face_angle=random.normal(0.005, 0.001),
        dynamic_loft=radians(random.normal(13.0, 0.1)),
        strike_x=random.normal(0.001, 0.0005),
        strike_y=random.normal(-0.002, 0.0005),
        source="encoders+model",
    )
    base |= {"status": ShotStatus.VALID}
    if number == 7:
        base |= {"status": ShotStatus.EXCLUDED, "reason": "club speed 0.6 m/s off the plan"}
    simulated = launch_columns(launch, "simulated") | flight_columns(flight, "simulated")
    shot = Shot(**base, **delivery_columns(delivery), **simulated)
    return ShotRecord(shot, cycles, flight)


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
    cycles["head_speed"] = np.linalg.norm(np.gradient(head, time, axis=0), axis=1)
    cycles["plant_head_speed"] = cycles["head_speed"]
    return cycles


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
    # Leant by a little, so that the wrist does not lie in its cushion.
    face = (site.ball_x - plant.ball.radius, site.ball_y, 3.5 * np.pi - 0.005)
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


@contextmanager
def _undrawn() -> Iterator[None]:
    def placed(_: Any, name: str) -> str:
        return f'<svg aria-hidden="true" focusable="false" id="{name}"><path d="M 0.0 0.0"/></svg>'

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bench.campaign.report._campaign_plots.to_svg", placed)
        yield


@pytest.fixture(scope="module")
def undrawn() -> Iterator[None]:
    """Leave an empty picture in each place, for all tests of a file."""
    with _undrawn():
        yield


@pytest.fixture
def undrawn_here() -> Iterator[None]:
    """Leave an empty picture in each place, for one test."""
    with _undrawn():
        yield
