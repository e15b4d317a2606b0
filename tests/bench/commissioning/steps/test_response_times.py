"""Spools and dead times, from steps at a stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bench.commissioning.machine.commissioning_step import MOVING, PRESSING, RobotEstimate, fold, slow_bounds
from bench.commissioning.machine.driver_machine import SimulatedMachine
from bench.commissioning.machine.machine import MotionTrace
from bench.commissioning.steps.response_times import _IMPOSSIBLE, RESPONSE, _pulses, fit_spool
from drivers.base import JOINTS
from sim.plant import PlantParameters

WRIST = 2


@pytest.fixture(scope="module")
def steps() -> MotionTrace:
    plant = PlantParameters()
    known = RobotEstimate(plant)
    with SimulatedMachine(plant, plant) as machine:
        machine.vent()
        fold(machine, known)
        machine.set_supply(MOVING)
        return machine.run(_pulses(known, WRIST), slow_bounds(plant, 1.2 * PRESSING))


def held(pressure: np.ndarray) -> np.ndarray:
    """Return `pressure` (n, 6) read in every second tick only."""
    return pressure[np.arange(len(pressure)) // 2 * 2]


def later(pressure: np.ndarray) -> np.ndarray:
    """Return `pressure` (n, 6) two ticks later."""
    return np.roll(pressure, 2, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seen", "dead_time", "tolerance"),
    [(lambda pressure: pressure, 0.0, 2e-5), (later, 0.002, 2e-5), (held, 0.0005, 3e-4)],
    ids=["at once", "two ticks later", "every second tick"],
)
def test_fit_spool_separates_dead_time_from_natural_frequency(
    steps: MotionTrace, seen: Callable[[np.ndarray], np.ndarray], dead_time: float, tolerance: float
) -> None:
    plant = PlantParameters()
    (frequency, error), (found, _) = fit_spool(
        replace(steps, pressure=seen(steps.pressure)), RobotEstimate(plant), WRIST
    )
    truth = plant.wrist.valve.natural_frequency
    assert abs(frequency - truth) < max(0.01 * truth, 3.0 * error)
    assert found == pytest.approx(dead_time, abs=tolerance)


@pytest.mark.parametrize(
    ("late", "latency", "impossible"), [(0.001, 0.0016, False), (-0.0016, 0.0, False), (-0.0019, 0.0, True)]
)
def test_response_step_latency_before_pressures_is_no_latency(
    monkeypatch: pytest.MonkeyPatch, late: float, latency: float, impossible: bool
) -> None:
    """Pressures that a bus brings later show the motion after the encoder does."""
    place = "bench.commissioning.steps.response_times"
    monkeypatch.setattr(f"{place}.fit_spool", lambda *_: ((600.0, 1.0), (0.0006, 1e-5)))
    monkeypatch.setattr(f"{place}.fit_latency", lambda *_: (late, 4e-4))
    names = [f"{joint} steps" for joint in JOINTS]
    traces: dict[str, Any] = dict.fromkeys([*names, "arm coasting 1"])
    values, notes = RESPONSE.estimate(traces, RobotEstimate(PlantParameters()))
    found = {value.key: value.value for value in values}
    assert found["encoders.latency"] == pytest.approx(latency)
    assert (_IMPOSSIBLE in notes) is impossible
    side = "before" if late < 0.0 else "behind"
    assert f"arm coasting 1: encoder {1e3 * abs(late):.3f} ± 0.400 ms {side} the pressures" in notes
