"""A drawn body: parts of one material each, and what they weigh together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bench.drawing.materials import Material
from bench.drawing.mesh import Mesh, joined_meshes
from bench.drawing.solids import Solid, Volume, joined
from sim.robot import Body, Club

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
