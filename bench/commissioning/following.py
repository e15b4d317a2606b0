"""Limits of the following error for the robot that was found: from how its model follows the swing.

The configured limits are those of another robot: one with more friction or smaller valves lags further behind
its reference in a healthy swing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bench.config import Configuration
from bench.lifecycle import Phase
from bench.simulation.series import Bench, Series
from bench.swing.profile import Profile

_ROOM = 1.5
"""Times the model's following error that are allowed at least."""
_DIGITS = 3
"""Of a limit, written and computed alike."""


def with_following_limits(known: Configuration, profile: Profile) -> Configuration:
    """Return `known` with following limits that leave `profile` room on its model; none is lower than before.

    Raises:
        Refused: the model does not come to its address.
    """
    free = replace(known.envelope.with_model_check("off"), following={})
    bench = Bench.of(replace(known, envelope=free), profile)
    cycles = Series(bench, bench.model).swing(profile, ball=True).cycles
    return replace(known, envelope=replace(known.envelope, following=_limits(known, cycles)))


def _limits(known: Configuration, cycles: np.ndarray[Any, Any]) -> dict[str, tuple[float, float, float]]:
    errors = np.abs(cycles["angle"] - cycles["reference_angle"])
    wider = {}
    for name, limits in known.envelope.following.items():
        in_phase = errors[cycles["phase"] == Phase[name.upper()]]
        needed = _ROOM * in_phase.max(axis=0, initial=0.0)
        a, b, c = np.maximum(np.round(needed, _DIGITS), limits).tolist()
        wider[name] = (a, b, c)
    return wider
