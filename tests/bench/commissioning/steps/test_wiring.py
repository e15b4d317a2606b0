"""Step 1 of commissioning: the wiring."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from bench.commissioning.machine.commissioning_step import MachineFault
from bench.commissioning.machine.machine import MotionTrace
from bench.commissioning.steps.wiring import _require_sensors, _vent_to_rest
from sim.plant import PlantParameters

PLANT = PlantParameters()


def vented(above: float, fall: float) -> MotionTrace:
    """Return a venting at whose end a chamber is `above` the atmosphere (Pa), and falls by `fall` (Pa/s)."""
    n = 1000
    time = np.linspace(0.0, 0.999, n)
    pressure = np.full((n, 6), PLANT.supply.atmosphere)
    pressure[:, 1] += above + fall * (time[-1] - time)
    zeros, none = np.zeros(n), np.zeros((n, 3))
    return MotionTrace(
        time, np.zeros(3, int), none.astype(int), pressure, zeros, none, zeros > 0, zeros.astype(int)
    )


def test_vent_to_rest_waits_until_no_chamber_falls() -> None:
    ventings = [vented(0.08e5, 0.1e5), vented(0.039e5, 0.05e5), vented(0.02e5, 0.0), vented(0.0, 0.0)]
    machine = SimpleNamespace(vent=partial(next, iter(ventings)))
    assert _vent_to_rest(machine) is ventings[2]


def test_require_sensors_zero_within_tolerance_passes() -> None:
    _require_sensors(vented(0.02e5, 0.0), PLANT)


@pytest.mark.parametrize("above", [0.039e5, -0.039e5])
def test_require_sensors_chamber_at_rest_off_atmosphere_is_fault(above: float) -> None:
    with pytest.raises(MachineFault, match="shoulder vane B sensor"):
        _require_sensors(vented(above, 0.0), PLANT)
