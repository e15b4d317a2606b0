"""What designing needs: the package `casadi`, an extra of 270 MB, and control by planned openings."""

from __future__ import annotations

from typing import Any

from bench.base.errors import BenchError
from bench.control.settings import ControlSettings


def load_casadi() -> Any:
    """Return the package.

    Raises:
        BenchError: it is not installed.
    """
    try:
        import casadi
    except ImportError as error:
        raise BenchError(
            "profile design",
            f"package casadi is not installed ({error})",
            "the package casadi",
            'Run pip install "golfbench[design]".',
        ) from error
    return casadi


def require_planned_openings(control: ControlSettings) -> None:
    """Raise BenchError unless `control` feeds the profile's openings forward."""
    if control.feed_forward != "planned":
        raise BenchError(
            "control.feed_forward",
            repr(control.feed_forward),
            '"planned": designing and learning change the planned openings',
            'Set feed_forward = "planned" for it.',
        )
