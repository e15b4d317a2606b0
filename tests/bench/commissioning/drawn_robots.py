"""Robots of the range that commissioning has to meet, and wrong machines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from datetime import UTC, datetime
from math import pi
from typing import Any

import numpy as np

from bench.commissioning.commissioning import robot_file
from bench.commissioning.machine.commissioning_step import ParameterEstimate, RobotEstimate
from bench.config import Configuration
from bench.control.measured_plant import value_at
from sim.plant import PlantParameters
from sim.pneumatics import Actuator
from sim.robot import Body


def drawn_robot(seed: int, nominal: PlantParameters | None = None) -> PlantParameters:
    """Return a robot drawn over the whole range."""
    plant, random = nominal or PlantParameters(), np.random.default_rng([seed, 17])

    def within(share: float) -> float:
        return float(random.uniform(1 - share, 1 + share))

    def between(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    def actuator(a: Actuator) -> Actuator:
        friction = float(np.exp(random.uniform(np.log(0.5), np.log(2.5))))
        valve = replace(
            a.valve,
            conductance=a.valve.conductance * within(0.3),
            critical_ratio=between(0.2, 0.5),
            dead_band=between(0.0, 0.05),
            leakage=a.valve.leakage * float(np.exp(random.uniform(np.log(0.2), np.log(5.0)))),
            natural_frequency=2 * pi * between(60.0, 150.0),
            centre=between(-0.03, 0.03),
        )
        return replace(
            a,
            area_a=a.area_a * within(0.25),
            area_b=a.area_b * within(0.25),
            dead_volume=a.dead_volume * within(0.4),
            cross_leakage=a.cross_leakage * float(np.exp(random.uniform(np.log(0.2), np.log(5.0)))),
            friction=replace(
                a.friction,
                viscous=a.friction.viscous * friction,
                coulomb=a.friction.coulomb * friction,
                static=a.friction.static * friction,
            ),
            valve=valve,
        )

    robot, club = plant.robot, plant.robot.club

    def length(value: float) -> float:
        return value + between(-2e-3, 2e-3)

    def body(b: Body) -> Body:
        return replace(b, mass=b.mass * within(0.1), inertia=b.inertia * within(0.1))

    club = replace(club, head_mass=club.head_mass * within(0.1), shaft_mass=club.shaft_mass * within(0.1))
    counts = plant.encoders.counts_per_revolution
    zeros, signs = random.uniform(0, counts, 3).tolist(), random.choice([-1, 1], 3).tolist()
    return replace(
        plant,
        robot=replace(
            robot,
            club=club,
            shoulder_link=body(robot.shoulder_link),
            left_arm=body(robot.left_arm),
            rod=body(robot.rod),
            cylinder=body(robot.cylinder),
            l12=length(robot.l12),
            l16=length(robot.l16),
            l23=length(robot.l23),
            l56=length(robot.l56),
        ),
        shoulder=actuator(plant.shoulder),
        right_arm=actuator(plant.right_arm),
        wrist=actuator(plant.wrist),
        wrist_lever=length(plant.wrist_lever),
        supply=replace(plant.supply, pressure=between(6.5e5, 9.0e5)),
        encoders=replace(
            plant.encoders,
            zero_count=(zeros[0], zeros[1], zeros[2]),
            sign=(signs[0], signs[1], signs[2]),
            latency=between(0.0, 0.002),
        ),
    )


def drawn_robot_file(robot: PlantParameters, configuration: Configuration) -> str:
    """Return `robot` as TOML over `configuration`, its limits of the supply's pressure as the robot's."""
    found = [
        ParameterEstimate(key, value, 0.0, "", "drawn")
        for (key, value), (_, before) in zip(_leaves(robot), _leaves(configuration.plant), strict=True)
        if value != before
    ]
    known, base = RobotEstimate(configuration.plant, found), str(configuration.files[-1].resolve())
    return robot_file(known, base, datetime(2026, 5, 1, tzinfo=UTC), configuration.envelope)


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted keys below `value` and what stands there."""
    if is_dataclass(value):
        for field in fields(value):
            yield from _leaves(getattr(value, field.name), f"{key}.{field.name}".lstrip("."))
    elif isinstance(value, tuple):
        for i, item in enumerate(value):
            yield from _leaves(item, f"{key}.{i}")
    else:
        yield key, value


def gap_of(found: ParameterEstimate, truth: PlantParameters) -> float:
    """Return the estimate less the truth; zeros of encoders within half a revolution."""
    gap = found.value - float(value_at(truth, found.key))
    if "zero_count" in found.key:
        counts = truth.encoders.counts_per_revolution
        gap = (gap + counts / 2) % counts - counts / 2
    return gap
