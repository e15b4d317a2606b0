"""Guard of designing and learning, which change planned openings: the controller must use them."""

from __future__ import annotations

from bench.control.settings import ControlSettings
from bench.errors import BenchError


def require_planned_openings(control: ControlSettings) -> None:
    """Raise BenchError unless `control` feeds the profile's openings forward."""
    if control.feed_forward != "planned":
        raise BenchError(
            "control.feed_forward",
            repr(control.feed_forward),
            '"planned": designing and learning change the planned openings',
            'Set feed_forward = "planned" for it; `golfbench profile compare` compares with the others.',
        )
