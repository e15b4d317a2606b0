"""Site of one club: the swing plane that follows its lie, ground and ball."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from math import pi, radians
from typing import Annotated

from drivers.base.ranges import Range
from sim.plant import PlantParameters, Site


@dataclass(frozen=True)
class ClubSite(Site):
    """A site that holds for one club, with the tilt of the robot's mount that it asks for."""

    plane: Annotated[float, Range(radians(20.0), pi / 2, "rad")] = radians(53.0)
    """Swing plane to the ground (rad), set at the robot's mount; gravity in the plane follows it."""

    @classmethod
    def of(cls, plant: PlantParameters) -> ClubSite:
        """Return where `plant` stands."""
        return cls(**{f.name: getattr(plant.site, f.name) for f in fields(Site)}, plane=plant.robot.lie)

    def applied_to(self, plant: PlantParameters) -> PlantParameters:
        """Return `plant` on this site, in this plane."""
        site = Site(**{f.name: getattr(self, f.name) for f in fields(Site)})
        return replace(plant, robot=replace(plant.robot, lie=self.plane), site=site)
