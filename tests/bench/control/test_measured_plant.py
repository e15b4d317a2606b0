"""Robots that could have been measured as another."""

from __future__ import annotations

import pytest

from bench.control.measured_plant import measured_as, value_at, with_values
from sim.plant import PlantParameters

PLANT = PlantParameters()
ERRORS = {"shoulder.area_a": 1e-5, "wrist.valve.centre": 1e-3, "encoders.latency": 1e-3}


def test_measured_as_changes_listed_values_by_standard_error() -> None:
    off: dict[str, list[float]] = {key: [] for key in ERRORS}
    for seed in range(400):
        drawn = measured_as(PLANT, ERRORS, seed)
        for key, error in ERRORS.items():
            off[key].append((value_at(drawn, key) - value_at(PLANT, key)) / error)
        assert drawn.encoders.latency >= 0.0
        assert with_values(drawn, {key: value_at(PLANT, key) for key in ERRORS}) == PLANT
    area = off["shoulder.area_a"]
    assert max(map(abs, area)) <= 3.0 + 1e-9
    assert sum(one * one for one in area) / 400 == pytest.approx(1.0, abs=0.25)
    assert measured_as(PLANT, ERRORS, 7) == measured_as(PLANT, ERRORS, 7)


def test_measured_as_keeps_area_ratio_of_actuator() -> None:
    errors = {"wrist.area_a": 0.02 * PLANT.wrist.area_a, "wrist.area_b": 0.02 * PLANT.wrist.area_b}
    for seed in range(20):
        drawn = measured_as(PLANT, errors, seed).wrist
        assert drawn.area_a / drawn.area_b == pytest.approx(PLANT.wrist.area_a / PLANT.wrist.area_b)


def test_measured_as_without_errors_returns_same_plant() -> None:
    assert measured_as(PLANT, {}, 7) == PLANT
