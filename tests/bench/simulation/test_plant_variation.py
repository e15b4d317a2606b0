"""Drawn plants lie around the one they are drawn from."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.simulation.plant_variation import CENTRE, healthy_plant
from sim.plant import PlantParameters


@pytest.mark.parametrize("seed", range(4))
def test_healthy_plant_valve_centres_vary_around_given_centre(seed: int) -> None:
    plant = PlantParameters()
    beside = replace(plant.wrist, valve=replace(plant.wrist.valve, centre=-0.03))
    drawn = healthy_plant(replace(plant, wrist=beside), seed)
    assert drawn.wrist.valve.centre == pytest.approx(-0.03, abs=CENTRE)
    assert drawn.shoulder.valve.centre == healthy_plant(plant, seed).shoulder.valve.centre
