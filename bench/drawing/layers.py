"""Where bodies lie along the normal of the swing plane, so that they pass each other, m.

The club swings in the plane itself, z = 0; the left arm lies before it, the right arm and the vane drive
behind. All are assumptions: the dynamics are those of a plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from sim.plant import PlantParameters
from sim.pneumatics import Actuator

PIN = 0.005
"""Radius of the joints' pins."""
GAP = 0.004
MOUNT_HEIGHT = 0.024
PLATE_HEIGHT = 0.006
LEVER_HEIGHT = 0.010
YOKE_HEIGHT = 0.010
WALL = 0.0025
"""Wall of a cylinder, assumed."""


def bore_radius(actuator: Actuator) -> float:
    """Return the radius of a cylinder's bore (m), from its full area."""
    return sqrt(max(actuator.area_a, actuator.area_b) / pi)


def rod_radius(actuator: Actuator) -> float:
    """Return the radius of a cylinder's rod (m): what the areas differ by, else a third of the bore."""
    least = bore_radius(actuator) / 3
    return max(sqrt(abs(actuator.area_a - actuator.area_b) / pi), least)


@dataclass(frozen=True)
class Layers:
    """Heights over the swing plane (m): middles of the bodies, front of the drive."""

    arm: float
    arm_front: float
    lever: float
    yoke: float
    right_arm: float
    drive: float


def layers(plant: PlantParameters, link: float, arm: float) -> Layers:
    """Return the heights for a link and an arm of the thicknesses `link` and `arm` (m)."""
    clear = max(link, MOUNT_HEIGHT) / 2 + GAP
    front = clear + arm
    lever = front + PLATE_HEIGHT + GAP + LEVER_HEIGHT / 2
    yoke = lever + LEVER_HEIGHT / 2 + GAP + YOKE_HEIGHT / 2
    cylinder = bore_radius(plant.right_arm) + WALL
    right = -clear - cylinder
    yoke = max(yoke, front + bore_radius(plant.wrist) + WALL)
    return Layers(clear + arm / 2, front, lever, yoke, right, right - cylinder - 2 * GAP)


def wrist_ways(plant: PlantParameters) -> tuple[float, float]:
    """Return the ends of that way over the wrist's range with its clearance (m)."""
    low, high = plant.wrist.chamber_ends
    turns = np.linspace(low, high, 721)
    ways = plant.wrist_stroke(turns)
    return float(ways.min()), float(ways.max())
