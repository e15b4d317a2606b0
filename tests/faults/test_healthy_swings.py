"""Plants within their tolerances swing without an alarm: a few here, 1,000 in the benchmark."""

from __future__ import annotations

import pytest

from bench.simulation.plant_variation import healthy_plant
from sim.plant import PlantParameters
from tests.benchmarks.healthy_swings import run
from tests.compiled_only import needs_speed


@pytest.mark.slow
@needs_speed
def test_fault_free_swings_raise_no_alarm() -> None:
    (row,) = run(["--swings", "12"])
    assert (row.value, row.holds) == (0, True), row.note


def test_healthy_plant_seeds_differ_and_repeat() -> None:
    plant = PlantParameters()
    assert healthy_plant(plant, 3) == healthy_plant(plant, 3) != healthy_plant(plant, 4)
    nominal = healthy_plant(plant, 0)
    assert nominal.shoulder.valve == plant.shoulder.valve
    assert nominal.supply == plant.supply
