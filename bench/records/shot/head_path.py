"""The club head's way to the ball, finer than the cycle.

At 1 kHz the head moves over 40 mm from one record to the next. Between two records the joint angles
follow the cubic through both angles and both velocities; across the impact, where velocities jump, the
last record before it is carried on with its own velocity and acceleration.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from bench.base.lifecycle import Phase
from sim.kinematics import forward_kinematics
from sim.robot import RobotParameters

_DOWN = (Phase.DOWNSWING, Phase.COMMITTED, Phase.IMPACT)

_EARLIEST_CONTACT = 0.004
"""How far (m) before the ball's position an off-centre strike may begin."""


class HeadPath(NamedTuple):
    """Centre of the face in the swing plane before it reaches `x_end`; times in s of the record."""

    time: np.ndarray
    position: np.ndarray
    """(n, 2) m."""


def path_to_ball(
    robot: RobotParameters, cycles: np.ndarray[Any, Any], x_end: float, length: float, points: int = 100
) -> HeadPath | None:
    """Return the last `length` metres of the downswing before the face's centre crosses `x_end` (m).

    Plant angles are taken where there are any, else the estimated ones. None when the head never
    crosses `x_end` in the downswing, as after a stop.
    """
    down = cycles[np.isin(cycles["phase"], _DOWN)]
    if len(down) < 3:
        return None
    simulated = bool(np.isfinite(down["plant_angle"]).all())
    angle, velocity = (
        (down["plant_angle"], down["plant_velocity"]) if simulated else (down["angle"], down["velocity"])
    )
    x = forward_kinematics(robot, angle)[:, 0]
    # Off its centre the face meets the ball up to some millimetres early: a record there may be after impact.
    before = x < x_end - _EARLIEST_CONTACT
    crossings = np.flatnonzero(before[:-1] & ~before[1:])
    if not crossings.size or not crossings[-1]:
        return None
    last = int(crossings[-1])
    times = down["time"][: last + 2].copy()
    acceleration = (velocity[last] - velocity[last - 1]) / (times[last] - times[last - 1])
    step = 1.25 * (times[last + 1] - times[last])
    times[last + 1] = times[last] + step
    ahead = angle[last] + step * (velocity[last] + step / 2 * acceleration)
    angles = np.vstack([angle[: last + 1], ahead])
    velocities = np.vstack([velocity[: last + 1], velocity[last] + step * acceleration])
    spline = CubicHermiteSpline(times, angles, velocities)
    start = max(0, last - 60)
    fine = np.linspace(times[start], times[-1], 50 * (len(times) - start))
    head = forward_kinematics(robot, spline(fine))[:, :2]
    inside = (head[:, 0] <= x_end) & (head[:, 0] >= x_end - length)
    if not inside.any():
        return None
    chosen = np.flatnonzero(inside)
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, points).astype(int))]
    return HeadPath(fine[chosen], head[chosen])
