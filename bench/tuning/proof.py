"""Proof of gains on whole simulated swings, as margins at frozen instants are not enough."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.errors import Refused
from bench.lifecycle import CAUSE_TEXT
from bench.simulation.series import Bench, Series
from sim.plant import PlantParameters

Array = NDArray[np.float64]


class Proof(NamedTuple):
    """One robot's swing with the gains of one bench."""

    backswing: Array
    """Root mean square of the following error up to the top, (3,) rad."""
    downswing: Array
    """Root mean square of the following error in the downswing, up to the impact window, (3,) rad."""
    failure: str
    """Why the swing failed; empty if it did not."""


def proof(bench: Bench, plant: PlantParameters) -> Proof:
    """Return the second swing of the bench's profile on the robot `plant`."""
    nothing = np.full(3, np.nan)
    try:
        series = Series(bench, plant)
        series.swing(bench.profile)
        swing = series.swing(bench.profile)
    except Refused:
        return Proof(nothing, nothing, "the robot does not come to rest at its address")
    if swing.cause:
        return Proof(nothing, nothing, f"stopped: {CAUSE_TEXT[swing.cause]}")
    begins = bench.profile.begins
    error = swing.cycles["reference_angle"] - swing.cycles["plant_angle"]

    def rms(first: int, last: int) -> Array:
        return np.asarray(np.sqrt(np.mean(error[first:last] ** 2, axis=0)))

    return Proof(rms(begins[1], begins[3]), rms(begins[3], begins[5]), "")
