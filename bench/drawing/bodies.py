"""Materials, and a drawn body: parts of one material each, and what they weigh together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.drawing.mesh import Mesh, joined_meshes
from bench.drawing.solids import Solid, Volume, joined
from sim.robot import Body, Club

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
        """The same without the pins and as if the bars had no bores: what the dynamics may count."""
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
