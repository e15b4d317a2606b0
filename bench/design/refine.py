"""Refinement of a planned downswing on the plant itself: least squares on the arrival at the ball.

The collocation's model rounds off friction, edges and stops. Played on the plant, its openings bring the head
to the ball a little early and low. Here a smooth correction of the openings, small by least squares, is
found with which the plant passes the ball as planned: strike point, shaft, velocity and turning, which
together are the three joints' speeds. The same input gives the same openings; a trial takes milliseconds.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bench.design.shooting import Arrival, Shooter

Array = NDArray[np.float64]

KNOT = 0.02
"""Time between knots of the correction, s."""
_DIFFERENCE = 1e-4
_THREADS = 2
UNITS = np.array([1e-4, 5e-4, 0.01, 0.01, 0.3])
"""Errors of strike (m), shaft (rad), head velocity (m/s) and turning (rad/s) that count as one."""
_MET = 4
"""How many of them must be below one: the shaft's turning is not required, the cushions are checked later."""
NEAR = 10.0
"""Remaining error that is still accepted: the closed loop corrects the aim later."""
_STAY = 0.3
"""Weight of the correction's size (of the stroke) beside those errors."""
_PASSES = 3
"""Number of passes; each starts from the openings of the one before and may go as far again."""
_ROUNDS = 30
"""Max number of rounds of a pass."""


class NotReached(RuntimeError):
    """The plant does not arrive at the ball as planned."""


def correction(knots: Array, ticks: int, period: float) -> Array:
    """Return the correction (ticks, 3) of straight lines from zero through `knots` (m, 3)."""
    corners = np.vstack([np.zeros(3), knots])
    at, times = np.arange(ticks) * period, np.arange(len(corners)) * KNOT
    return np.column_stack([np.interp(at, times, corners[:, i]) for i in range(3)])


def arrival_errors(arrival: Arrival, wanted: Array) -> Array:
    """Return the difference of `arrival` from `wanted`: strike m, theta_t rad, vx, vy m/s, omega rad/s."""
    return np.asarray(np.concatenate([[arrival.error], arrival.head[2:6]]) - wanted)


def refine(shooter: Shooter, plan: Array, wanted: Array, opening: float) -> Array:
    """Return openings (n, 3), one row a tick, with which the plant arrives as `wanted` (`arrival_errors`).

    `plan` (n, 3) are the planned openings, `opening` the max one.

    Raises:
        NotReached: no such openings near the plan.
    """
    left = np.full(len(wanted), np.inf)
    for _ in range(_PASSES):
        plan, left = _corrected(shooter, plan, wanted, opening)
        if np.abs(left[:_MET]).max() < 1.0:
            return plan
    if np.abs(left[:_MET]).max() < NEAR:
        return plan
    raise NotReached(
        f"the plant stays {np.array2string(left, precision=1)} tolerances off the planned arrival"
        " (strike, shaft, velocity in x and y, turning)"
    )


def _corrected(shooter: Shooter, plan: Array, wanted: Array, opening: float) -> tuple[Array, Array]:
    """Return openings, by least squares around `plan`, and the remaining errors in UNITS."""
    period, ticks = shooter.plant.parameters.tick, len(plan)
    shape = (int(np.ceil(ticks * period / KNOT)), 3)

    def openings(point: Array) -> Array:
        return np.clip(plan + correction(point.reshape(shape), ticks, period), -opening, opening)

    def errors(point: Array) -> Array:
        return np.asarray(arrival_errors(shooter.arrive(openings(point)), wanted) / UNITS)

    def residuals(point: Array) -> Array:
        return np.concatenate([errors(point), _STAY * point])

    with ThreadPoolExecutor(_THREADS) as pool:

        def slopes(point: Array) -> Array:
            def column(i: int) -> Array:
                shift = np.zeros(len(point))
                shift[i] = _DIFFERENCE
                return (residuals(point + shift) - residuals(point - shift)) / (2 * _DIFFERENCE)

            return np.stack(list(pool.map(column, range(len(point)))), axis=1)

        def note(intermediate_result: Any) -> None:
            if np.abs(intermediate_result.fun[:_MET]).max() < 1.0:
                raise StopIteration

        found = least_squares(
            residuals,
            np.zeros(shape[0] * 3),
            jac=slopes,
            bounds=(-0.5, 0.5),
            max_nfev=_ROUNDS,
            callback=note,
            xtol=1e-8,
            ftol=1e-6,
            x_scale=0.05,
        )
    return openings(found.x), errors(found.x)
