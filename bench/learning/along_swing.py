"""Margins and damping of the loop, linearised at instants of a simulated swing.

They describe the loop up to the top only. At the top dry friction holds the joints, and the downswing ends
before most of the growing modes of a frozen instant matter: both are reported, but not judged. Complete
simulated swings validate the gains.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import BenchError, Refused
from bench.base.lifecycle import CAUSE_TEXT
from bench.control.law.gain_table import Gains, gains_at
from bench.control.law.linear_loop import (
    Estimator,
    LinearPlant,
    Margins,
    OperatingPoint,
    estimator_response,
    least_damping,
    loop_responses,
    margins_of,
)
from bench.simulation.simulated_bench import Bench, Series, quiet
from sim.plant import PlantParameters


class JointLoop(NamedTuple):
    """One joint's loop at one instant."""

    point: str
    joint: int
    margins: Margins


class LoopMargins(NamedTuple):
    """All loops with some gains."""

    loops: tuple[JointLoop, ...]
    damping_ratio: dict[str, float]
    """Min damping ratio of the closed loop's modes, by instant; negative if a mode grows."""


def operating_points(bench: Bench) -> list[OperatingPoint]:
    """Return instants of the bench's swing, simulated with its model.

    Raises:
        BenchError: the swing is stopped.
        Refused: the robot does not reach its address.
    """
    profile, plant = bench.profile, quiet(bench.plant)
    _, backswing, top, down, _, window, _ = profile.begins
    instants = {
        "address": 0,
        "backswing 1/3": backswing + (top - backswing) // 3,
        "backswing 2/3": backswing + 2 * (top - backswing) // 3,
        "top": down - 1,
        "downswing 1/3": down + (window - down) // 3,
        "downswing 2/3": down + 2 * (window - down) // 3,
        "at the ball": window - 1,
    }
    series = Series(bench, plant)
    series.swing(profile)
    swing = series.swing(profile)
    if swing.cause:
        found, action = f"stopped: {CAUSE_TEXT[swing.cause]}", "Take a profile of this configuration."
        raise BenchError(f"a swing of {profile.name}", found, "a whole swing on the model", action)
    points = []
    for name, tick in instants.items():
        cycle = swing.cycles[tick]
        motion = np.concatenate([cycle[f"plant_{kind}"] for kind in ("angle", "velocity", "pressure")])
        share = bench.control.downswing_damping if tick >= down else 1.0
        supply = float(cycle["supply_pressure"])
        points.append(
            OperatingPoint(name, motion, supply, cycle["applied_valve"].copy(), share, tick < down - 1)
        )
    return points


def gains_along(bench: Bench) -> Callable[[LinearPlant], Gains]:
    """Return the function from an instant to the bench's gains there."""
    record = bench.controller().pid
    return lambda frozen: gains_at(record, frozen.point.motion[:3])


def judge(
    plants: list[LinearPlant], estimator: Estimator, gains: Callable[[LinearPlant], Gains], period: float
) -> LoopMargins:
    """Return the margins of all joints' loops at all instants, and how the closed loop is damped."""
    loops, ratios = [], {}
    for frozen in plants:
        name, own = frozen.point.name, gains(frozen)
        estimated = estimator_response(estimator, frozen.frequency, period)
        responses = loop_responses(frozen, estimated, own, period)
        loops += [JointLoop(name, i, margins_of(frozen.frequency, responses[:, i])) for i in range(3)]
        ratios[name] = least_damping(frozen, estimator, own, period)
    return LoopMargins(tuple(loops), ratios)


Array = NDArray[np.float64]


class ValidationSwing(NamedTuple):
    """One robot's swing with the gains of one bench."""

    backswing: Array
    """Root mean square of the following error up to the top, (3,) rad."""
    downswing: Array
    """Root mean square of the following error in the downswing, up to the impact window, (3,) rad."""
    failure: str
    """Why the swing failed; empty if it did not."""


def proof(bench: Bench, plant: PlantParameters) -> ValidationSwing:
    """Return the second swing of the bench's profile on the robot `plant`."""
    nothing = np.full(3, np.nan)
    try:
        series = Series(bench, plant)
        series.swing(bench.profile)
        swing = series.swing(bench.profile)
    except Refused:
        return ValidationSwing(nothing, nothing, "the robot does not come to rest at its address")
    if swing.cause:
        return ValidationSwing(nothing, nothing, f"stopped: {CAUSE_TEXT[swing.cause]}")
    begins = bench.profile.begins
    error = swing.cycles["reference_angle"] - swing.cycles["plant_angle"]

    def rms(first: int, last: int) -> Array:
        return np.asarray(np.sqrt(np.mean(error[first:last] ** 2, axis=0)))

    return ValidationSwing(rms(begins[1], begins[3]), rms(begins[3], begins[5]), "")
