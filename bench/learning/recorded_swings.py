"""Recorded swings for identification and learning: of one profile, each complete."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.errors import BenchError
from bench.lifecycle import Phase
from bench.shot.recorded_shot import plant_of
from bench.swing.correction import digest_of
from bench.swing.profile import Profile
from bench.telemetry.recorder import read_swing
from bench.telemetry.swing_metadata import read_profile
from sim.plant import Encoders

Cycles = np.ndarray[Any, Any]


class Recorded(NamedTuple):
    """A swing that the robot made, not its first after arming."""

    profile: Profile
    """As it was swung, a correction included."""
    cycles: Cycles
    """CYCLE records from its first tick."""
    encoders: Encoders
    """With the calibration of that time."""


def read_recorded(paths: Sequence[Path]) -> list[Recorded]:
    """Return the swings in Parquet files.

    Raises:
        BenchError: one is no record, holds no whole swing, or was planned otherwise than the first.
    """
    swings: list[Recorded] = []
    for path in paths:
        cycles, metadata = read_swing(path)
        profile = read_profile(metadata, str(path))
        require_alike(swings[0].profile if swings else profile, profile, str(path))
        encoders = plant_of(metadata, str(path))[0].encoders
        swings.append(Recorded(profile, from_first_tick(cycles, profile, str(path)), encoders))
    return swings


def from_first_tick(cycles: Cycles, profile: Profile, place: str) -> Cycles:
    """Return the records of a swing from its first tick on.

    Raises:
        BenchError: they hold no swing up to the impact window.
    """
    begun = np.flatnonzero(cycles["phase"] == Phase.BACKSWING)
    first = int(begun[0]) - profile.begins[1] if begun.size else -1
    swing = cycles[max(first, 0) :]
    if first < 0 or len(swing) < profile.begins[5] or swing["trip"][: profile.begins[5]].any():
        raise BenchError(
            place,
            "no complete swing",
            "a swing from the address to the ball",
            "Give a record of a complete swing.",
        )
    return swing


def require_alike(one: Profile, other: Profile, place: str) -> None:
    """Refuse swings with different plans or corrections; `place` names the other's record.

    Raises:
        BenchError: they were not.
    """
    if digest_of(one) != digest_of(other):
        found = f"a swing of {other.name}" + (", with another correction" if one.name == other.name else "")
        raise BenchError(place, found, f"of {one.name}, as in the records before", "Identify one at a time.")
