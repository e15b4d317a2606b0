"""The ramp finds a valve's centre and dead band, on made-up data and on the software plant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.calibration.valve_centre import SWEEP, find_centre, ramp_valve
from sim.plant import PlantParameters

OPENINGS = np.linspace(-0.3, 0.3, 121)


def answer(
    centre: float, band: float, below: float = 9e6, above: float = 1.2e7, level: float = 0.0
) -> np.ndarray:
    beyond = (
        np.minimum(OPENINGS - centre + band, 0.0) * below + np.maximum(OPENINGS - centre - band, 0.0) * above
    )
    return level + beyond


@given(
    centre=st.floats(-0.15, 0.15),
    band=st.floats(0.01, 0.08),
    below=st.floats(3e6, 3e7),
    above=st.floats(3e6, 3e7),
    level=st.floats(-3e4, 3e4),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40, deadline=None)
def test_find_centre_synthetic_ramp_finds_centre_and_dead_band(
    centre: float, band: float, below: float, above: float, level: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    rates = answer(centre, band, below, above, level) + 2e-4 * min(below, above) * random.standard_normal(
        len(OPENINGS)
    )
    order = random.permutation(len(OPENINGS))
    found = find_centre(OPENINGS[order], rates[order])
    assert found.centre == pytest.approx(centre, abs=1e-3)
    assert found.dead_band == pytest.approx(band, abs=1e-3)
    assert 0 < found.residual < 1e-3


@pytest.mark.parametrize(
    ("openings", "rates", "text"),
    [
        (OPENINGS, answer(0.0, 0.02)[:-1], "one length"),
        (OPENINGS, np.where(OPENINGS == 0.3, np.nan, answer(0.0, 0.02)), "finite"),
        (OPENINGS[:5], answer(0.0, 0.02)[:5], "5 measurements"),
        (np.zeros(121), answer(0.0, 0.02), "121 measurements"),
        (OPENINGS, np.zeros(121), "do not go from falling to rising"),
        (OPENINGS, -answer(0.0, 0.02), "do not go from falling to rising"),
        (OPENINGS, np.abs(answer(0.0, 0.02)), "do not go from falling to rising"),
        (OPENINGS, np.random.default_rng(1).standard_normal(121), "do not go from falling to rising"),
        (OPENINGS, answer(0.29, 0.02), "do not go from falling|upper edge"),
        (OPENINGS, answer(-0.27, 0.02), "lower edge"),
    ],
)
def test_find_centre_invalid_ramp_raises_value_error(
    openings: np.ndarray, rates: np.ndarray, text: str
) -> None:
    with pytest.raises(ValueError, match=text):
        find_centre(openings, rates)


@pytest.mark.parametrize(("centre", "band"), [(0.0, 0.02), (0.03, 0.02), (-0.12, 0.05), (0.02, 0.1)])
@pytest.mark.parametrize("actuator", [0, 1, 2])
def test_find_centre_simulated_valve_finds_centre_and_dead_band(
    actuator: int, centre: float, band: float
) -> None:
    plant = PlantParameters()
    name = ("shoulder", "right_arm", "wrist")[actuator]
    one = getattr(plant, name)
    plant = replace(plant, **{name: replace(one, valve=replace(one.valve, centre=centre, dead_band=band))})
    found = find_centre(*ramp_valve(plant, actuator))
    step = SWEEP[1] - SWEEP[0]
    assert found.centre == pytest.approx(centre, abs=step / 10)
    assert found.dead_band == pytest.approx(band, abs=step / 2)
    assert found.residual < step / 10
