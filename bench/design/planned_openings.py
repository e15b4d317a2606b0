"""Designing and learning change a profile's planned openings: the controller has to take them."""

from __future__ import annotations

from bench.control.settings import ControlSettings
from bench.errors import BenchError


def require_planned_openings(control: ControlSettings) -> None:
    """Raise BenchError unless `control` feeds the profile's openings forward."""
    if control.feed_forward != "planned":
        raise BenchError(
            "control.feed_forward",
            repr(control.feed_forward),
            '"planned": what is designed or learned are the profile\'s openings',
            'Set feed_forward = "planned" for it; `golfbench swing compare` compares with the others.',
        )
