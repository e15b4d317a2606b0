"""Plants with realistic deviations from the nominal one: unknown ones, and tolerances of a known one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sim.plant import PlantParameters
from sim.pneumatics import Actuator

Three = tuple[float, float, float]
_ONES: Three = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Variation:
    """Factors on a plant's parameters, and additions to them; joints and valves in order."""

    friction: Three = _ONES
    """Factors on viscous, Coulomb and static friction."""
    flow: Three = _ONES
    """Factors on the valves' conductance."""
    volume: Three = _ONES
    """Factors on the dead volumes."""
    supply: float = 1.0
    """Factor on the regulated pressure."""
    vane: float = 1.0
    """Factor on the vane's area."""
    head_mass: float = 0.0
    """Added mass of the head, kg."""
    latency: float = 0.0
    """Added latency of the encoders, s."""

    def applied_to(self, plant: PlantParameters) -> PlantParameters:
        """Return `plant` with these deviations."""

        def varied(actuator: Actuator, i: int, area: float = 1.0) -> Actuator:
            friction, valve = actuator.friction, actuator.valve
            return replace(
                actuator,
                area_a=actuator.area_a * area,
                area_b=actuator.area_b * area,
                dead_volume=actuator.dead_volume * self.volume[i],
                friction=replace(
                    friction,
                    viscous=friction.viscous * self.friction[i],
                    coulomb=friction.coulomb * self.friction[i],
                    static=friction.static * self.friction[i],
                ),
                valve=replace(valve, conductance=valve.conductance * self.flow[i]),
            )

        robot, club = plant.robot, plant.robot.club
        return replace(
            plant,
            robot=replace(robot, club=replace(club, head_mass=club.head_mass + self.head_mass)),
            shoulder=varied(plant.shoulder, 0, self.vane),
            right_arm=varied(plant.right_arm, 1),
            wrist=varied(plant.wrist, 2),
            supply=replace(plant.supply, pressure=plant.supply.pressure * self.supply),
            encoders=replace(plant.encoders, latency=plant.encoders.latency + self.latency),
        )


WORN = Variation(
    friction=(1.4, 1.4, 1.4),
    flow=(0.92, 0.92, 0.92),
    supply=0.96,
    vane=1.03,
    head_mass=0.010,
    latency=0.001,
)
"""A worn robot with other valves and another head: all deviations at once."""


def worn(share: float) -> Variation:
    """Return a variation with `share` of the deviations of WORN."""

    def part(factor: float) -> float:
        return 1.0 + share * (factor - 1.0)

    def parts(factors: Three) -> Three:
        a, b, c = map(part, factors)
        return a, b, c

    return Variation(
        friction=parts(WORN.friction),
        flow=parts(WORN.flow),
        volume=parts(WORN.volume),
        supply=part(WORN.supply),
        vane=part(WORN.vane),
        head_mass=share * WORN.head_mass,
        latency=share * WORN.latency,
    )


def drawn(seed: int, plant: PlantParameters, spread: float = 0.10) -> Variation:
    """Return a variation with every factor uniform within 1 -+ `spread`, and up to 1 ms more latency."""
    random = np.random.default_rng(seed)

    def factors() -> Three:
        a, b, c = (1.0 + spread * random.uniform(-1, 1, 3)).tolist()
        return a, b, c

    friction, flow, volume = factors(), factors(), factors()
    supply, vane, mass = (spread * random.uniform(-1, 1, 3)).tolist()
    return Variation(
        friction,
        flow,
        volume,
        1.0 + supply,
        1.0 + vane,
        plant.robot.club.head_mass * mass,
        0.001 * float(random.uniform()),
    )


TOLERANCE = {
    "conductance": 0.025,
    "spool frequency": 0.05,
    "dead band": 0.15,
    "friction": 0.15,
    "dead volume": 0.05,
    "supply pressure": 0.01,
    "inertia": 0.01,
}
"""Shares of the nominal value that calibration and a good maker leave; assumption."""
CENTRE = 0.0015
"""Max offset of a valve's centre, in openings."""
LEAKAGE = 2.0
"""Leakages are up to this many times their nominal value above it, and half of it below."""
NOISE, JITTER = 1e-5, 2e-6
"""Max noise and jitter of the encoders, rad and s."""


def healthy_plant(plant: PlantParameters, seed: int, spread: float = 1.0) -> PlantParameters:
    """Return `plant` within `spread` times its tolerances, drawn with `seed`; seed 0 is the nominal one."""
    random = np.random.default_rng(seed)
    spread = spread if seed else 0.0

    def about_1(name: str) -> float:
        return float(1.0 + spread * TOLERANCE[name] * random.uniform(-1.0, 1.0))

    def leaking() -> float:
        return float(1.0 + spread * random.uniform(-0.5, LEAKAGE)) if spread else 1.0

    def actuator(a: Actuator) -> Actuator:
        coulomb = a.friction.coulomb * about_1("friction")
        static = max(a.friction.static * about_1("friction"), 1.05 * coulomb)
        friction = replace(
            a.friction, viscous=a.friction.viscous * about_1("friction"), coulomb=coulomb, static=static
        )
        valve = replace(
            a.valve,
            conductance=a.valve.conductance * about_1("conductance"),
            natural_frequency=a.valve.natural_frequency * about_1("spool frequency"),
            dead_band=a.valve.dead_band * about_1("dead band"),
            leakage=a.valve.leakage * leaking(),
            centre=a.valve.centre + spread * CENTRE * float(random.uniform(-1.0, 1.0)),
        )
        return replace(
            a,
            dead_volume=a.dead_volume * about_1("dead volume"),
            cross_leakage=a.cross_leakage * leaking(),
            friction=friction,
            valve=valve,
        )

    robot, supply = plant.robot, plant.supply
    left, link, club = robot.left_arm, robot.shoulder_link, robot.club
    return replace(
        plant,
        shoulder=actuator(plant.shoulder),
        right_arm=actuator(plant.right_arm),
        wrist=actuator(plant.wrist),
        supply=replace(supply, pressure=supply.pressure * about_1("supply pressure")),
        robot=replace(
            robot,
            left_arm=replace(left, inertia=left.inertia * about_1("inertia")),
            shoulder_link=replace(link, inertia=link.inertia * about_1("inertia")),
            club=replace(club, head_mass=club.head_mass * about_1("inertia")),
        ),
        encoders=replace(
            plant.encoders,
            noise=spread * NOISE * float(random.uniform()),
            jitter=spread * JITTER * float(random.uniform()),
        ),
        seed=seed + 1,
    )


def unknown_plant(plant: PlantParameters, seed: int) -> PlantParameters:
    """Return a robot to learn on, drawn with `seed`: every other one within 10 % of `plant`, the rest worn.

    All have the tolerances of a known one on top.
    """
    share = float(np.random.default_rng([seed, 1]).uniform())
    variation = worn(share) if seed % 2 else drawn(seed, plant)
    return variation.applied_to(healthy_plant(plant, seed))
