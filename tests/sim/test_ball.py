"""The ball's own checks; density and viscosity of air against published values."""

from __future__ import annotations

from typing import Any

import pytest

from sim.ball import Air, Ball


def test_ball_default_conforms_to_rules() -> None:
    ball = Ball()
    assert ball.mass <= 0.04593
    assert 2 * ball.radius >= 0.04267
    assert ball.inertia == pytest.approx(0.4 * 0.04593 * 0.021335**2)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"mass": 45.93}, r"Ball\.mass: found 45\.93, expected 0\.02 to 0\.06 kg"),
        ({"radius": 0.0427}, r"Ball\.radius: found 0\.0427"),
        ({"inertia_factor": 0.0}, r"Ball\.inertia_factor"),
        ({"friction": float("nan")}, r"Ball\.friction: found nan"),
        ({"drag_factor": -1.0}, r"Ball\.drag_factor: found -1\.0, expected 0 to 3$"),
    ],
)
def test_ball_unphysical_value_raises(values: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Ball(**values)


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
