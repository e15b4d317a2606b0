"""Drawn plants lie around the one they are drawn from."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.simulation.plant_variation import CENTRE, healthy_plant
from sim.plant import PlantParameters


@pytest.mark.parametrize("seed", range(4))
def test_the_centres_of_healthy_valves_lie_around_the_known_ones(seed: int) -> None:
    plant = PlantParameters()
    beside = replace(plant.wrist, valve=replace(plant.wrist.valve, centre=-0.03))
    drawn = healthy_plant(replace(plant, wrist=beside), seed)
    assert drawn.wrist.valve.centre == pytest.approx(-0.03, abs=CENTRE)
    assert drawn.shoulder.valve.centre == healthy_plant(plant, seed).shoulder.valve.centre
