"""The safety check of simulated runs: each limit alone, and NaN is never safe."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from typing import Any

import numpy as np
import pytest

from bench.simulation.safety import (
    Loads,
    RunEnd,
    SafetyLimits,
    loads_of,
    pressure_shares,
    reset_peaks,
    stop_shares,
    unsafe_reasons,
)
from sim.plant import PlantParameters, build_plant, initial_state

LIGHT = Loads(np.zeros((3, 2)), np.full(6, 5e5), 0.02, 40.0, 0.5, "wrist lower stop", 0.1, 0.6)
LIMITS = SafetyLimits(min_frame_distance=0.1, access_pressure=1.2e5)
SAFE = RunEnd(LIGHT, True, 0.3, 1.0, 0.001, 1.0e5)


def test_unsafe_reasons_within_limits_is_empty() -> None:
    assert unsafe_reasons(SAFE, LIMITS) == []
    assert unsafe_reasons(RunEnd(LIGHT), LIMITS) == []  # nothing else was observed


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("stop_share", 1.2, "wrist lower stop took 120 % of its rated energy"),
        ("pressure_share", 1.01, "a chamber reached 101 % of its rating"),
        ("lowest_clearance", -0.006, "the head went 6 mm into the ground"),
        ("stop_share", nan, "rated energy"),
        ("pressure_share", nan, "its rating"),
        ("lowest_clearance", nan, "into the ground"),
        ("rested", False, "come to rest"),
        ("frame_distance", 0.09, "within 90 mm of the shoulder axis"),
        ("frame_distance", nan, "shoulder axis"),
        ("head_share", 1.06, "106 % of the profile's speed"),
        ("head_share", nan, "profile's speed"),
        ("creep", 0.03, "moved by 0.03 rad"),
        ("creep", nan, "moved by"),
        ("access_pressure", 2.0e5, "released with 2.0 bar"),
        ("access_pressure", nan, "released with"),
        ("armed_again", True, "armed again"),
    ],
)
def test_unsafe_reasons_value_beyond_limit_or_nan_is_reported(name: str, value: Any, reason: str) -> None:
    changed: dict[str, Any] = {name: value}
    if hasattr(LIGHT, name):
        changed = {"loads": replace(LIGHT, **changed)}
    (found,) = unsafe_reasons(SAFE._replace(**changed), LIMITS)
    assert reason in found


def test_unsafe_reasons_divot_allowance_extends_ground_limit() -> None:
    deep = replace(LIGHT, lowest_clearance=-0.016)
    assert unsafe_reasons(SAFE._replace(loads=replace(deep, divot=0.012)), LIMITS) == []
    (found,) = unsafe_reasons(SAFE._replace(loads=replace(deep, divot=0.010)), LIMITS)
    assert "16 mm into the ground" in found
    site = replace(PlantParameters().site, surface="turf", divot=0.012)
    plant = replace(PlantParameters(), site=site)
    assert loads_of(initial_state(build_plant(plant), np.array([0.4, 4.0, 6.0])), plant).divot == 0.012


def test_loads_of_returns_shares_of_ratings() -> None:
    plant = PlantParameters()
    state = initial_state(build_plant(plant), np.array([0.4, 4.0, 6.0]))
    reset_peaks(state)
    assert loads_of(state, plant).lowest_clearance == np.inf
    state["stop_energy"][0, 1, 1] = 0.5 * plant.right_arm.stop.energy
    state["stop_depth"][0, 1, 1] = 0.7 * plant.right_arm.stop.travel
    state["peak_pressure"][0, 4] = 0.9 * plant.wrist.pressure_rating
    found = loads_of(state, plant)
    assert found.stop == "arm upper stop"
    assert found.stop_share == pytest.approx(0.5)
    assert found.depth_share == pytest.approx(0.7)
    assert found.pressure_share == pytest.approx(0.9)
    assert stop_shares(np.zeros((7, 3, 2)), plant).shape == (7, 3, 2)
    assert pressure_shares(found.peak_pressure, plant).shape == (3, 2)
    reset_peaks(state)
    assert loads_of(state, plant).stop_share == 0.0


def test_loads_of_uses_shock_absorber_rating_above_spring_energy() -> None:
    plant = PlantParameters()
    stop = plant.wrist.stop
    assert stop.rating == stop.rated > stop.energy
    assert stop.stiffness == replace(stop, rated=0.0).stiffness
    assert replace(stop, rated=0.0).rating == stop.energy
    state = initial_state(build_plant(plant), np.array([0.4, 4.0, 6.0]))
    reset_peaks(state)
    state["stop_energy"][0, 2, 1] = stop.energy
    assert loads_of(state, plant).stop_share == pytest.approx(stop.energy / stop.rated)
