"""Density and viscosity of air against published values."""

from __future__ import annotations

import pytest

from sim.air import Air


def test_air_density_matches_published_values() -> None:
    # Standard references: dry air at 0 degrees C and 1 atm, and CIPM's 20 degrees C at 50 % humidity.
    assert Air(273.15, 101325.0, 0.0).density == pytest.approx(1.2930, abs=3e-4)
    assert Air(293.15, 101325.0, 0.5).density == pytest.approx(1.1993, abs=3e-4)
    assert Air(293.15, 101325.0, 0.0).density == pytest.approx(1.2045, abs=3e-4)


def test_air_default_matches_launch_monitor_normalisation() -> None:
    assert Air().density == pytest.approx(1.1773, abs=1e-4)
    assert Air().viscosity / Air().density == pytest.approx(1.56e-5, abs=1e-8)


def test_air_viscosity_matches_published_value() -> None:
    assert Air(293.15).viscosity == pytest.approx(1.813e-5, abs=1e-8)


def test_air_density_falls_with_humidity_and_temperature() -> None:
    assert Air(relative_humidity=1.0).density < Air(relative_humidity=0.0).density
    assert Air(temperature=308.15).density < Air().density


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"temperature": 25.0}, r"Air\.temperature: found 25\.0, expected 233\.15 to 333\.15 K"),
        ({"pressure": 1013.25}, r"Air\.pressure: found 1013\.25"),
        ({"relative_humidity": 50.0}, r"Air\.relative_humidity: found 50\.0, .*0\.5 is 50 %"),
        ({"temperature": float("nan")}, r"Air\.temperature: found nan"),
    ],
)
def test_air_unphysical_value_raises(values: dict[str, float], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Air(**values)
