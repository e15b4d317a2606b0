"""The pressure observer's estimate of the vents."""

from __future__ import annotations

import numpy as np
import pytest

from bench.control.estimate.air import conductance_of_vents
from drivers.base.compiled import new_record
from drivers.base.records import READINGS
from sim.plant import PlantParameters, build_plant

PLANT = build_plant(PlantParameters()).plant[0]


@pytest.mark.parametrize(
    ("shown", "opened"),
    [
        ((np.nan, np.nan), True),
        ((1.0, 1.0), True),
        ((0.0, 1.0), True),
        ((0.0, np.nan), True),
        ((0.0, 0.0), False),
    ],
)
def test_conductance_of_vents_both_reported_shut_is_zero(shown: tuple[float, float], opened: bool) -> None:
    readings = new_record(READINGS)
    readings["vent_open"] = shown
    assert (conductance_of_vents(PLANT, readings[0], PLANT["vent_delay"] + 0.1) > 0.0) is opened
    assert conductance_of_vents(PLANT, readings[0], PLANT["vent_delay"]) == 0.0
