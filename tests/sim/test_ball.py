"""The ball's own checks."""

from __future__ import annotations

from typing import Any

import pytest

from sim.ball import Ball


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
