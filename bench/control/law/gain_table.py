"""Gains over the pose: a table on a grid of joint angles, interpolated in every tick.

The pose is that of the reference: gains then carry no noise back into the loop. While encoders have no zeros
yet the middle of the grid is taken. Gains also follow the supply's pressure, as it is at the address: a spool
passes air in proportion to it.
"""

from __future__ import annotations

from math import floor, inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.base.compiled import compiled, fields, new_record

Array = NDArray[np.float64]
Triple = tuple[float, float, float]


class Gains(NamedTuple):
    """Valve command per rad, rad s, rad/s and rad/s2; and per rad/s of the reference in slow moves."""

    proportional: Triple
    integral: Triple
    derivative: Triple
    damping: Triple
    move: Triple


SHAPE = (7, 5, 7)
"""Poses along shoulder, arm and wrist."""
PROPORTIONAL, INTEGRAL, DERIVATIVE, DAMPING, MOVE = range(5)
_ROWS = len(Gains._fields)
_SUPPLY = (0.7, 1.4)
"""Range of the factor on the gains by the supply's pressure."""

PID_PARAMETERS = np.dtype(
    [*fields("f8", "lower spacing", (3,)), ("supply", "f8"), ("table", "f8", (*SHAPE, _ROWS, 3))], align=True
)
"""Angles of the first pose (rad), distances of the poses (rad), the supply's pressure for which the gains
hold (Pa; 0 where they do not follow it), gains in the order of `Gains`, joints last."""


def gain_record(lower: Array, spacing: Array, supply: float, table: Array) -> np.ndarray[Any, Any]:
    """Return a PID_PARAMETERS record of its fields.

    Raises:
        ValueError: a gain is negative or not finite.
    """
    if not (np.isfinite(table).all() and np.min(table) >= 0.0):
        raise ValueError("gains must be finite and not negative")
    record = new_record(PID_PARAMETERS)
    record["lower"], record["spacing"], record["supply"], record["table"] = lower, spacing, supply, table
    return record


def constant_gains(gains: Gains) -> np.ndarray[Any, Any]:
    """Return a PID_PARAMETERS record with the same `gains` at every pose and supply pressure.

    Raises:
        ValueError: a gain is negative or not finite.
    """
    for name, values in gains._asdict().items():
        if not all(0.0 <= value < inf for value in values):
            raise ValueError(f"{name}: gains must be finite and not negative, found {values}")
    return gain_record(np.zeros(3), np.ones(3), 0.0, np.array(gains))


def gains_at(record: Any, pose: Array) -> Gains:
    """Return the gains of a PID_PARAMETERS `record` at `pose` (3,) rad and the supply that they hold for."""
    a, b, c, d, e = (tuple(row.tolist()) for row in gains_along(record, pose[None])[0])
    return Gains(a, b, c, d, e)


def gains_along(record: Any, poses: Array, factor: float = 1.0) -> Array:
    """Return the gains (n, 5, 3) of a PID_PARAMETERS `record` at `poses` (n, 3) rad, times `factor`."""
    found = np.zeros((len(poses), _ROWS, 3))
    for gains, pose in zip(found, poses, strict=True):
        interpolate_gains(gains, record[0], pose, factor)
    return found


@compiled
def interpolate_gains(gains: Any, p: Any, pose: Any, factor: float) -> None:
    """Set `gains` (5, 3) at `pose` (3,) rad, times `factor`; `p` is PID_PARAMETERS.

    Outside the grid its border holds; an angle that is NaN is taken as the lowest.
    """
    a, u = _cell(pose[0], p.lower[0], p.spacing[0], SHAPE[0])
    b, v = _cell(pose[1], p.lower[1], p.spacing[1], SHAPE[1])
    c, w = _cell(pose[2], p.lower[2], p.spacing[2], SHAPE[2])
    t = p.table
    for r in range(_ROWS):
        for i in range(3):
            near = _between(
                _between(t[a, b, c, r, i], t[a, b, c + 1, r, i], w),
                _between(t[a, b + 1, c, r, i], t[a, b + 1, c + 1, r, i], w),
                v,
            )
            far = _between(
                _between(t[a + 1, b, c, r, i], t[a + 1, b, c + 1, r, i], w),
                _between(t[a + 1, b + 1, c, r, i], t[a + 1, b + 1, c + 1, r, i], w),
                v,
            )
            gains[r, i] = factor * _between(near, far, u)


@compiled
def middle_pose(p: Any) -> tuple[float, float, float]:
    """Return the joint angles (rad) in the middle of the grid."""
    return (
        p.lower[0] + 0.5 * (SHAPE[0] - 1) * p.spacing[0],
        p.lower[1] + 0.5 * (SHAPE[1] - 1) * p.spacing[1],
        p.lower[2] + 0.5 * (SHAPE[2] - 1) * p.spacing[2],
    )


@compiled
def supply_factor(supply: float, pressure: float) -> float:
    """Return the factor on gains that hold at `supply` where the supply has `pressure`; Pa."""
    if not (supply > 0.0 and pressure > 0.0):
        return 1.0
    return min(max(supply / pressure, _SUPPLY[0]), _SUPPLY[1])


@compiled
def _cell(angle: float, lower: float, spacing: float, count: int) -> tuple[int, float]:
    """Return the pose below `angle` and the fraction of the way to the next one."""
    position = (angle - lower) / spacing
    if not position > 0.0:
        return 0, 0.0
    if position >= count - 1.0:
        return count - 2, 1.0
    below = floor(position)
    return below, position - below


@compiled
def _between(one: float, other: float, share: float) -> float:
    # Equal values give exactly that value, so that manual gains stay unchanged.
    return one + share * (other - one)
