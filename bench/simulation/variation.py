"""Plants with realistic deviations from the nominal one."""

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
