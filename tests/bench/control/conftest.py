"""Fixtures of the control tests: plain versions of compiled functions, and a synthetic swing."""

from __future__ import annotations

import types
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

PERIOD = 1e-3
IMPACT = 0.93
"""Time of the synthetic swing's impact, s."""


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` as plain Python, with its compiled callees plain as well."""
    source = getattr(function, "py_func", function)
    callees = {
        name: _plain(value)
        for name, value in source.__globals__.items()
        if name in source.__code__.co_names and hasattr(value, "py_func")
    }
    names = source.__globals__ | callees
    return types.FunctionType(source.__code__, names, source.__name__, source.__defaults__)


@pytest.fixture(scope="session")
def plain() -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the function that makes a compiled one plain; its records are `.view(np.recarray)`."""
    return _plain


class Swing(NamedTuple):
    """A swing at times (n,) s: angle (n, 3) rad, velocity rad/s, acceleration rad/s² without the blow."""

    time: np.ndarray[Any, Any]
    angle: np.ndarray[Any, Any]
    velocity: np.ndarray[Any, Any]
    acceleration: np.ndarray[Any, Any]


_STEPS = 100
"""Fine steps per period."""

# Per joint: pieces of acceleration (rad/s²) with start, end and ramp (s); the velocity's jump at the ball.
_PIECES = (
    ((-12, 0.1, 0.4, 0.05), (12, 0.4, 0.7, 0.05), (90, 0.75, 0.9, 0.02), (-60, 0.9, 0.97, 0.01)),
    ((-6, 0.1, 0.4, 0.05), (6, 0.4, 0.7, 0.05), (60, 0.75, 0.85, 0.02), (-150, 0.92, 0.96, 0.01)),
    (
        (5, 0.1, 0.4, 0.05),
        (-5, 0.4, 0.7, 0.05),
        (-60, 0.75, 0.8, 0.01),
        (150, 0.8, 0.86, 0.01),
        (1500, 0.905, 0.935, 0.006),
        (-2500, 0.938, 0.952, 0.003),
    ),
)
_JUMP = (-1.5, 0.4, -12.0)


def synthetic_swing(phase: float = 0.0, duration: float = 1.1) -> Swing:
    """Return a backswing, downswing, blow and braking with a real swing's speeds and accelerations.

    The wrist reaches 38 rad/s at 1500 rad/s², loses 12 rad/s at the ball and brakes at 2500 rad/s².
    `phase` (0…1) shifts the ticks against the impact by that part of a period.
    """

    def ramp(x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        s = np.clip(x, 0.0, 1.0)
        height: np.ndarray[Any, Any] = s * s * (3.0 - 2.0 * s)
        return height

    step = PERIOD / _STEPS
    time = np.arange(round(duration / step)) * step
    acceleration = np.array(
        [
            sum(a * (ramp((time - begin) / r) - ramp((time - end + r) / r)) for a, begin, end, r in pieces)
            for pieces in _PIECES
        ]
    ).T
    jump = np.outer(time >= IMPACT - 0.5 * step, _JUMP)
    velocity = np.cumsum(acceleration, axis=0) * step + jump
    angle = np.cumsum(velocity, axis=0) * step
    ticks = slice(round(phase * _STEPS), None, _STEPS)
    return Swing(time[ticks], angle[ticks], velocity[ticks], acceleration[ticks])


@pytest.fixture(scope="session")
def swing() -> Callable[..., Swing]:
    """Return `synthetic_swing`."""
    return synthetic_swing
