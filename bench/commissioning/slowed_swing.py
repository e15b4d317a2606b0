"""A slower swing along the path of a designed one: its reference stretched in time.

A design at less than half the speed is not reliable: its plan spends most of its time near the top, where dry
friction decides. Here the loop follows the same path more slowly; what it delivers need not be a good shot.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.config import Configuration
from bench.control.gain_table import MOVE, gains_along
from bench.control.settings import pid_record
from bench.swing.profile import Profile, as_written

_PATTERN = 3
"""Columns of the openings in the blind brakes' table; the rest are durations."""


def slowed(profile: Profile, share: float, configuration: Configuration) -> Profile:
    """Return `profile` at `share` (0 to 1) of its speed from the backswing on.

    Its openings are those that move the joints on at the reference's speed.
    """
    c = configuration
    begin, rows = profile.begins[1], len(profile.angle)
    stretched = begin + round((rows - 1 - begin) / share) + 1
    at = np.concatenate([np.arange(begin), begin + share * np.arange(stretched - begin)])
    angle = _at_rows(profile.angle, at)
    velocity = np.gradient(angle, profile.period, axis=0)
    velocity[:begin] = 0.0
    gain = gains_along(pid_record(c.control, c.estimator, c.plant), angle)[:, MOVE]
    nearest = at[:: profile.blind_spacing] // profile.blind_spacing
    blind = profile.blind_brake[nearest.astype(int)]
    blind[:, _PATTERN:] *= share  # less motion is left to brake
    begins = tuple(row if row <= begin else begin + round((row - begin) / share) for row in profile.begins)
    time = begin * profile.period
    return as_written(
        replace(
            profile,
            name=f"{profile.name} at {100 * share:.0f} %",
            begins=begins,
            angle=angle,
            velocity=velocity,
            valve=np.clip(velocity * gain, -1.0, 1.0),
            blind_brake=blind,
            impact_time=time + (profile.impact_time - time) / share,
            delivery={},
            limits={},
        )
    )


def _at_rows(table: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the values of `table` (n, 3) at fractional `rows` (k,), (k, 3)."""
    return np.column_stack([np.interp(rows, np.arange(len(table)), column) for column in table.T])
