"""Feed-forward of the backswing, and refinement of a planned downswing on the plant itself.

Refinement of a planned downswing on the plant itself: least squares on the arrival at the ball. The
collocation's model rounds off friction, edges and stops. Played on the plant, its openings bring the head to
the ball a little early and low. Here a smooth correction of the openings, small by least squares, is found
with which the plant passes the ball as planned: strike point, shaft, velocity and turning, which together are
the three joints' speeds. The same input gives the same openings; a trial takes milliseconds.

Feed-forward of the backswing: iterative learning control in simulated iterations. The tracking error, mapped
through the inverse of the loop, corrects the openings of the next iteration. On the linear model of
`bench.control.law.gain_scheduling` an added opening u changes the error e of its joint, the others held, by

    e''' / b + (m + c / b) e'' + (d + k) e' + p e = -u

with the PIDs' proportional and derivative gains p and d, the damping m, and authority b, slowness k and
friction c of the joint. Errors are smoothed over some periods of the dither,
which moves the joints to and fro and is not to be undone.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bench.control.law.gain_scheduling import joint_chains
from bench.control.law.gain_table import DAMPING, DERIVATIVE, PROPORTIONAL, gains_along
from bench.design.closed_loop import LoopFailed, Rehearsal
from bench.design.shooting import Arrival, Shooter
from bench.simulation.simulated_bench import SimulatedBench
from bench.swing.profile import Profile
from sim.plant import build_plant

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
"""Weight of the correction's size (share of the stroke) relative to those errors."""
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


_REHEARSALS = 12
_SHARE = 0.4
"""Share of the inverse that is applied: with friction the error does not follow its linear model."""
_NEAR = 0.03
"""Max error that is not worth another rehearsal, as a share of its limit."""
_SMOOTHED = 4
"""Periods of the dither over which an error is smoothed."""
_APART = 50
"""Rows between two poses at which the linear model is made."""


class Backswing(NamedTuple):
    """A rehearsed way to the top."""

    profile: Profile
    """Profile with the learned openings."""
    rehearsal: Rehearsal
    """The bench at the top."""
    cycles: NDArray[Any]
    """CYCLE records of the way."""
    error: float
    """Max error in following it, as a share of its limit."""


def learned_backswing(bench: SimulatedBench, pid: NDArray[Any], ticks: int, highest: float) -> Backswing:
    """Return the way up in the first `ticks` of the bench's profile, as closely followed as is learned.

    `pid` is the PIDs' record, `highest` the max opening that is planned.

    Raises:
        LoopFailed: the envelope stops the first rehearsal, or the robot does not come to its address.
    """
    terms = _terms(bench, pid, bench.profile.angle[:ticks])
    best = latest = _rehearsed(bench, ticks)
    for _ in range(_REHEARSALS - 1):
        if best.error < _NEAR:
            break
        opening = latest.profile.valve.copy()
        opening[1:ticks] += _SHARE * _missing(bench, terms, latest.cycles)[1:]
        np.clip(opening, -highest, highest, out=opening)
        bench = replace(bench, profile=replace(bench.profile, valve=opening))
        try:
            latest = _rehearsed(bench, ticks)
        except LoopFailed:
            break
        if latest.error < best.error:
            best = latest
    return best


def _rehearsed(bench: SimulatedBench, ticks: int) -> Backswing:
    # A wrist that lags folds beyond the lever's limit: the learned swing is to keep it, not each rehearsal.
    free = replace(bench, envelope=replace(bench.envelope, min_lever=0.0))
    rehearsal = Rehearsal(free)
    cycles = rehearsal.advance(ticks)
    error = (
        np.abs(cycles["reference_angle"] - cycles["angle"]) / bench.envelope.max_following_error["backswing"]
    )
    return Backswing(bench.profile, rehearsal, cycles, float(error.max()))


def _terms(bench: SimulatedBench, pid: NDArray[Any], angle: Array) -> Array:
    """Return openings (4, n, 3) per rad, rad/s, rad/s2 and rad/s3 of error, along `angle` (n, 3) rad."""
    plant, gains = build_plant(bench.plant), gains_along(pid, angle)
    at = np.arange(len(angle))
    rows = np.append(at[::_APART], at[-1])
    poses = [joint_chains(plant, angle[row]) for row in rows]

    def along(values: list[Array]) -> Array:
        return np.column_stack([np.interp(at, rows, joint) for joint in np.array(values).T])

    return np.array(
        [
            gains[:, PROPORTIONAL],
            gains[:, DERIVATIVE] + along([pose.slowness for pose in poses]),
            gains[:, DAMPING] + along([pose.friction / pose.authority for pose in poses]),
            along([1.0 / pose.authority for pose in poses]),
        ]
    )


def _missing(bench: SimulatedBench, terms: Array, cycles: NDArray[Any]) -> Array:
    """Return the openings (n, 3) that would have undone the errors in `cycles`."""
    from scipy.signal import savgol_filter  # here, for it takes long to import

    period = bench.profile.period
    window = 2 * round(_SMOOTHED * bench.control.dither_period / period / 2) + 1
    error = cycles["reference_angle"] - cycles["angle"]
    missing: Array = np.zeros(error.shape)
    for order, term in enumerate(terms):
        missing += term * savgol_filter(error, window, 3, deriv=order, delta=period, axis=0, mode="nearest")
    return missing
