"""What wears is found by part in swings, and in an arming that was stopped for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from bench.base.errors import Refused
from bench.commissioning.swings.wear import (
    PartWear,
    SwingWear,
    WearingValue,
    fitted_wear,
    wear_plot,
    wearing_values,
    worn_parts,
)
from bench.config import Configuration
from bench.control.measured_plant import value_at, with_values
from bench.simulation.simulated_bench import Bench, PoweredBench
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.plant import PlantParameters, build_plant
from tests.compiled_only import needs_speed

Values = tuple[WearingValue, ...]


@pytest.fixture(scope="module")
def bench(configuration: Configuration) -> Bench:
    path = find_profile(configuration.swing.profile)
    profile = load_profile(path)
    c = configuration.for_profile(profile, path)
    return Bench.of(c, profile)


def _powered(bench: Bench, plant: PlantParameters) -> PoweredBench:
    powered = PoweredBench(bench)
    powered.engine.stepper.plant = build_plant(plant)
    powered.engine.begin_record()
    return powered


def _swung(bench: Bench, plant: PlantParameters) -> np.ndarray:
    powered = _powered(bench, plant)
    assert powered.arm()
    return powered.swing(plant.ball).cycles


def _parts(bench: Bench, cycles: np.ndarray) -> list[PartWear]:
    return worn_parts([fitted_wear(cycles, bench.plant)])


def _changes(parts: Sequence[PartWear]) -> dict[tuple[str, str], float]:
    return {(one.value.part, one.value.name): one.latest for one in parts}


@needs_speed
def test_worn_parts_several_changes_are_found_in_one_swing(bench: Bench) -> None:
    plant = bench.plant
    band, speed = plant.right_arm.valve.dead_band, plant.wrist.valve.natural_frequency
    friction = {
        f"right_arm.friction.{kind}": 1.3 * float(value_at(plant, f"right_arm.friction.{kind}"))
        for kind in ("coulomb", "static", "viscous")
    }
    values = {
        "right_arm.valve.dead_band": band + 0.006,
        "wrist.valve.natural_frequency": 0.88 * speed,
        "shoulder.valve.centre": 0.003,
        "wrist.cross_leakage": plant.wrist.cross_leakage + 1.5e-10,
    }
    found = _changes(_parts(bench, _swung(bench, with_values(plant, values | friction))))
    expected = {
        ("arm valve", "dead band"): 0.006,
        ("wrist valve", "spool speed"): -0.12,
        ("shoulder valve", "centre"): 0.003,
        ("wrist seals", "leak"): 1.5e-10,
        ("arm", "friction"): 0.3,
    }
    for name, change in expected.items():
        assert found[name] == pytest.approx(change, rel=0.2), name
    most = {(one.part, one.name): one.most for one in wearing_values(plant)}
    others = {name for name in found if abs(found[name]) > 0.35 * most[name]}
    assert others - {("shoulder seals", "leak"), ("club", "head mass")} <= set(expected)  # hardly determined


@needs_speed
def test_worn_parts_stopped_arming_names_valve_not_sensor(bench: Bench) -> None:
    powered = _powered(bench, with_values(bench.plant, {"right_arm.valve.centre": 0.008}))
    with pytest.raises(Refused, match="check its sensor"):
        powered.arm()
    worn = [one for one in _parts(bench, powered.engine.record()) if one.is_worn]
    assert [(one.value.part, one.value.name) for one in worn] == [("arm valve", "centre")]
    assert worn[0].latest == pytest.approx(0.008, rel=0.1)


@needs_speed
def test_worn_parts_sensor_offset_names_sensor_not_valve(bench: Bench) -> None:
    cycles = _swung(bench, bench.plant).copy()
    cycles["chamber_pressure"][:, 2] += 1.5e4
    worn = [one for one in _parts(bench, cycles) if one.is_worn]
    assert [(one.value.part, one.value.name) for one in worn] == [("arm sensor", "chamber A")]
    assert worn[0].latest == pytest.approx(1.5e4, rel=0.3)


@needs_speed
def test_worn_parts_fault_free_robot_finds_none(bench: Bench) -> None:
    assert not [one for one in _parts(bench, _swung(bench, bench.plant)) if one.is_worn]


def _drifting(values: Values, swings: int, k: int, change: float) -> list[SwingWear]:
    rows = np.zeros((swings, len(values)))
    rows[:, k] = np.linspace(0.0, change, swings)
    return [SwingWear(values, row, np.full(len(values), 1e-6)) for row in rows]


def test_worn_parts_trend_predicts_swings_left() -> None:
    values = wearing_values(PlantParameters())
    k = next(n for n, one in enumerate(values) if (one.part, one.name) == ("wrist valve", "dead band"))
    first = worn_parts(_drifting(values, 20, k, 0.5 * values[k].most))[0]
    assert (first.value, first.is_worn) == (values[k], False)
    # Medians of the first and last five: 14 of 20 steps apart.
    assert first.left == pytest.approx((1.0 - 0.5 * 15 / 19) / (0.5 / 19), rel=0.05)


def test_worn_parts_leak_below_zero_is_not_worn() -> None:
    values = wearing_values(PlantParameters())
    k = next(n for n, one in enumerate(values) if one.name == "leak")
    for sign, worn in ((-1.0, False), (1.0, True)):
        rows = _drifting(values, 3, k, 0.0)
        rows = [
            one._replace(change=one.change + sign * 1.5 * values[k].most * (np.arange(len(values)) == k))
            for one in rows
        ]
        assert worn_parts(rows)[0].is_worn is worn


def test_wear_plot_shows_most_worn_first() -> None:
    values = wearing_values(PlantParameters())
    figure = wear_plot(_drifting(values, 12, 3, values[3].most), range(1, 13))
    assert len(figure.axes) == 6
    assert figure.axes[0].get_title(loc="left") == f"{values[3].part}: {values[3].name}"
