from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from bench.config import VARIANTS, load_configuration
from bench.viewer.drawing.bodies import Mesh
from sim.plant import PlantParameters


def _plants() -> Iterator[tuple[str, PlantParameters]]:
    shipped = load_configuration(None)
    yield "shipped", shipped.plant
    yield "lever at an angle", replace(shipped.plant, wrist_lever_angle=0.6)
    for name in ("small_plant", "swing_through_wrist"):
        yield name, load_configuration(VARIANTS / f"{name}.toml").plant
    bag = load_configuration(VARIANTS / "bag.toml")
    for name in bag.clubs:
        yield name, bag.plant_with(club=name)


PLANTS = dict(_plants())
SIZED = {name: load_configuration(VARIANTS / f"{name}.toml").plant for name in ("high_speed", "golfers")}
"""Machines with larger parts: the dynamics keep the shipped masses, which drawn cylinders exceed."""


@pytest.fixture(params=PLANTS, scope="session")
def plant(request: pytest.FixtureRequest) -> PlantParameters:
    """Every shipped robot, and the default one with every club."""
    return PLANTS[request.param]


@pytest.fixture(scope="session")
def shipped() -> PlantParameters:
    return PLANTS["shipped"]


def mesh_volume(mesh: Mesh) -> float:
    """Return the volume (m3) that a closed mesh encloses."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)
