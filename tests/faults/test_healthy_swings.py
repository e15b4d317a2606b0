"""Plants within their tolerances swing without an alarm: a few here, 1,000 in the benchmark."""

from __future__ import annotations

import numba
import pytest

from sim.plant import PlantParameters
from tests.benchmarks.healthy_swings import drawn_plant, run


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="a whole swing takes minutes without compilation")
def test_no_alarm_without_a_fault() -> None:
    (row,) = run(["--swings", "12"])
    assert (row.value, row.holds) == (0, True), row.note


def test_the_drawn_plants_differ_and_repeat() -> None:
    plant = PlantParameters()
    assert drawn_plant(plant, 3) == drawn_plant(plant, 3) != drawn_plant(plant, 4)
    nominal = drawn_plant(plant, 0)
    assert nominal.shoulder.valve == plant.shoulder.valve
    assert nominal.supply == plant.supply
