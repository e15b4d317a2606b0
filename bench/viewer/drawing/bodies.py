"""Materials, drawn bodies and what they weigh, and their layers along the normal of the swing plane.

Where bodies lie along the normal of the swing plane, so that they pass each other, m. The club swings in the
plane itself, z = 0; the left arm lies before it, the right arm and the vane drive behind. All are
assumptions: the dynamics are those of a plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.viewer.drawing.solids import Mesh, Solid, Volume, joined, joined_meshes
from sim.plant import PlantParameters
from sim.pneumatics import Actuator
from sim.robot import Body, Club

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
    """Return the radius of a rod (m), from the areas' difference; at least a third of the bore's radius."""
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


Colour = tuple[int, int, int]

_POUND_PER_CUBIC_INCH = 0.45359237 / 0.00001639  # as in the thesis, kg/m3


class Material(NamedTuple):
    """Name, density (kg/m3) and colour (red, green, blue, 0 to 255) of a part."""

    name: str
    density: float
    colour: Colour


STEEL = Material("steel", 0.283 * _POUND_PER_CUBIC_INCH, (112, 122, 136))
ALUMINIUM = Material("aluminium", 0.098 * _POUND_PER_CUBIC_INCH, (196, 203, 211))
CYLINDER = ALUMINIUM._replace(name="cylinder", colour=(38, 112, 178))
CHROME = STEEL._replace(name="chrome", colour=(228, 231, 235))
MOUNT = ALUMINIUM._replace(name="mount", colour=(235, 153, 40))
COMPOSITE = Material("composite", 1600.0, (40, 42, 46))
SHAFT_STEEL = STEEL._replace(name="shaft steel", colour=(150, 154, 160))
ACETAL = Material("acetal", 1410.0, (238, 238, 232))
HEAD = Material("head", 0.0, (172, 32, 40))
FRAME = STEEL._replace(name="frame", colour=(72, 80, 92))
GUARD = Material("hollow profile", 1060.0, (170, 178, 160))
TEE = Material("tee", 700.0, (240, 196, 110))
BALL = Material("ball", 0.0, (255, 255, 255))


def envelope(material: Material, mass: float, volume: float) -> Material:
    """Return `material` with the mean density of a bought part of `mass` (kg) drawn as `volume` (m3)."""
    return material._replace(density=mass / volume)


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """One solid of one material; a `joint` part is a pin, which the dynamics do not count."""

    name: str
    solid: Solid
    material: Material
    joint: bool = False

    @property
    def mass(self) -> float:
        """Mass (kg); 0 if it is counted elsewhere."""
        return self.material.density * self.solid.volume.volume


@dataclass(frozen=True)
class DrawnBody:
    """A body in its own frame, with the body of the dynamics that it stands for, if any."""

    name: str
    parts: tuple[Part, ...]
    assumed: Body | Club | None = None

    @cached_property
    def weighed(self) -> Volume:
        """Mass (kg), centre of mass (m) and inertia tensor about it (kg m2) of all parts."""
        return joined([(part.material.density, part.solid.volume) for part in self.parts])

    @cached_property
    def without_joints(self) -> Volume:
        """The same without pins and bores: the mass that the dynamics model includes."""
        return joined(
            [
                (part.material.density, getattr(part.solid, "stock", part.solid.volume))
                for part in self.parts
                if not part.joint
            ]
        )

    @cached_property
    def mesh(self) -> Mesh:
        """Surface of all parts."""
        return joined_meshes([part.solid.mesh for part in self.parts])

    @cached_property
    def colours(self) -> NDArray[np.uint8]:
        """Colour of each vertex of `mesh`, (n, 3)."""
        rows = [np.tile(part.material.colour, (len(part.solid.mesh.vertices), 1)) for part in self.parts]
        return np.concatenate(rows).astype(np.uint8)
