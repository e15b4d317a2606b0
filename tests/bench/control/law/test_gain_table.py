"""Gains over the pose: exact where they are constant, continuous, bounded by the grid, by the supply."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.lifecycle import Phase
from bench.control.law.gain_table import (
    SHAPE,
    Gains,
    constant_gains,
    gain_record,
    gains_along,
    gains_at,
    interpolate_gains,
    supply_factor,
)
from bench.control.settings import build_controller
from bench.control.step import decide_tick, estimate_tick
from bench.control.step_records import new_control_state
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.compiled import new_record
from drivers.base.records import READINGS
from sim.plant import PlantParameters

Array = np.ndarray[Any, Any]
LOWER, SPACING = np.array([-1.0, 4.0, 5.0]), np.array([0.5, 0.1, 0.2])
GIVEN = Gains(
    (2.0, 0.65, 0.1 + 0.2), (0.5, 0.8, 0.45), (0.165, 0.024, 0.1), (0.0046, 1e-7, 0.0), (1.0, 2.0, 3.0)
)


def linear() -> Array:
    """Return gains that are linear in each angle's place on the grid."""
    a, b, c = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    table = np.ones((*SHAPE, 5, 3)) * (1 + a + 10 * b + 100 * c)[..., None, None]
    table *= np.arange(1, 16).reshape(5, 3)
    return gain_record(LOWER, SPACING, 0.0, table)


angle = st.floats(-50.0, 50.0)


@given(pose=st.tuples(angle, angle, angle))
def test_constant_gains_are_exact_in_each_pose(pose: tuple[float, float, float]) -> None:
    assert gains_at(constant_gains(GIVEN), np.array(pose)) == GIVEN


@pytest.mark.parametrize("value", [-1e-9, np.nan, np.inf])
def test_constant_gains_invalid_gain_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="derivative"):
        constant_gains(GIVEN._replace(derivative=(0.0, value, 0.0)))


@given(pose=st.tuples(angle, angle, angle))
def test_gains_along_interpolates_and_clamps_at_grid_border(
    pose: tuple[float, float, float],
) -> None:
    location = np.clip((np.array(pose) - LOWER) / SPACING, 0.0, np.array(SHAPE) - 1.0)
    expected = (1 + location @ [1.0, 10.0, 100.0]) * np.arange(1, 16).reshape(5, 3)
    found = gains_along(linear(), np.array([pose]))[0]
    assert found == pytest.approx(expected, rel=1e-12)


def test_interpolate_gains_nan_angle_uses_lowest_pose() -> None:
    found, nothing = np.zeros((5, 3)), np.full(3, np.nan)
    interpolate_gains(found, linear()[0], nothing, 2.0)
    assert found == pytest.approx(2.0 * np.arange(1, 16).reshape(5, 3))


def test_interpolate_gains_compiled_equals_plain(plain: Callable[..., Any]) -> None:
    by_hand, table = np.zeros((5, 3)), linear()
    for pose in np.random.default_rng(4).uniform(-2.0, 8.0, (50, 3)):
        plain(interpolate_gains)(by_hand, table.view(np.recarray)[0], pose, 0.9)
        assert gains_along(table, pose[None], 0.9)[0].tolist() == by_hand.tolist()


@pytest.mark.parametrize(
    ("supply", "pressure", "factor"),
    [
        (8e5, 8e5, 1.0),
        (8e5, 6.4e5, 1.25),
        (8e5, 1e5, 1.4),
        (8e5, 2e6, 0.7),
        (8e5, np.nan, 1.0),
        (8e5, 0.0, 1.0),
        (8e5, -1.0, 1.0),
        (0.0, 5e5, 1.0),
    ],
)
def test_supply_factor_follows_pressure_within_bounds(supply: float, pressure: float, factor: float) -> None:
    assert supply_factor(supply, pressure) == pytest.approx(factor)


def test_supply_factor_of_address_is_kept_in_swing() -> None:
    """A swing draws the supply down by half a bar: gains that followed it would deviate from the plan."""
    parameters = build_controller(PlantParameters(), load_profile(find_profile("default")))
    parameters.pid["supply"] = 8e5
    state, readings = new_control_state(), new_record(READINGS)
    factors = list[float]()
    for phase, pressure in ((Phase.HOLD, 7.0e5), (Phase.DOWNSWING, 6.0e5), (Phase.RETURN, 6.5e5)):
        readings["supply_pressure"] = pressure
        estimate_tick(state, parameters, readings, 0.001 * len(factors))
        state.control["phase"] = phase
        decide_tick(state, parameters, readings, 0.001 * len(factors))
        factors.append(float(state.pid["supply_factor"][0]))
    assert factors == pytest.approx([8.0 / 7.0] * 3)
