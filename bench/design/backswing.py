"""Feed-forward of the backswing: what the feedback had to do in a rehearsal is done beforehand in the next.

Iterative learning control with the inverse of the loop. On the linear model of `bench.control.machine_gains`
an opening u that is added changes the error e of its joint, the others held, by

    e''' / b + (m + c / b) e'' + (d + k) e' + p e = -u

with the PIDs' proportional and derivative gains p and d, the damping m, and authority b, slowness k and
friction c of the joint. Errors are smoothed over some periods of the dither,
which moves the joints to and fro and is not to be undone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.gain_table import DAMPING, DERIVATIVE, PROPORTIONAL, gains_along
from bench.control.machine_gains import joint_chains
from bench.design.closed_loop import LoopFailed, Rehearsal
from bench.simulation.simulated_bench import SimulatedBench
from bench.swing.profile import Profile
from sim.plant import build_plant

Array = NDArray[np.float64]

_REHEARSALS = 12
_SHARE = 0.4
"""Of the inverse that is taken: friction makes the error answer otherwise than its linear model."""
_NEAR = 0.03
"""Max error that is not worth another rehearsal, as a share of its limit."""
_SMOOTHED = 4
"""Periods of the dither over which an error is smoothed."""
_APART = 50
"""Rows between two poses at which the linear model is made."""


class Backswing(NamedTuple):
    """A rehearsed way to the top."""

    profile: Profile
    """With the openings that were learned."""
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
    # A wrist that lags folds beyond the lever's limit: what is learned is to keep it, not each rehearsal.
    free = replace(bench, envelope=replace(bench.envelope, min_lever=0.0))
    rehearsal = Rehearsal(free)
    cycles = rehearsal.advance(ticks)
    error = np.abs(cycles["reference_angle"] - cycles["angle"]) / bench.envelope.following["backswing"]
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
