"""The order of a slow move: all joints together, or arm and wrist before the shoulder.

Together the head passes below the line between both ends, and lower still where dry friction holds the arm
back for a while. Where that comes too near to the ground, arm and wrist go first if that lifts the head.
"""

from __future__ import annotations

from typing import Any

from bench.control.envelope import spare_clearance
from drivers.base.compiled import compiled
from sim.kinematics import head_motion

_SHOULDER = 0
"""Index of the shoulder in drivers.base.JOINTS."""
_MIN_MARGIN = 0.030
"""Sufficient height over the required clearance (m): an arm that sticks until its PID moves it costs 23
mm."""
_MIN_IMPROVEMENT = 0.001
"""Required gain in ground clearance to change the order (m)."""
_POSES = 24
"""Number of poses checked on a path."""


@compiled
def moves_arm_first(parameters: Any, start: Any) -> bool:
    """Return whether arm and wrist go before the shoulder on the way from `start` (3,) rad to the address."""
    together = _spare(parameters, start, False)
    if together >= _MIN_MARGIN:
        return False
    return bool(_spare(parameters, start, True) > together + _MIN_IMPROVEMENT)


@compiled
def joint_progress(part: float, joint: int, first: bool) -> float:
    """Return the progress (0 to 1) of `joint` at `part` of the move.

    With `first`, arm and wrist use the first half and the shoulder the second.
    """
    if not first:
        return part
    own = 2.0 * part - 1.0 if joint == _SHOULDER else 2.0 * part
    return min(max(own, 0.0), 1.0)


@compiled
def _spare(parameters: Any, start: Any, first: bool) -> float:
    """Return the min spare clearance (m) of the head on its path; negative where it is too low."""
    p, robot, end = parameters.envelope[0], parameters.robot[0], parameters.angle[0]
    least = 10.0
    for k in range(_POSES + 1):
        # Scalars, as the step allocates nothing.
        shoulder = start[0] + (end[0] - start[0]) * joint_progress(k / _POSES, 0, first)
        arm = start[1] + (end[1] - start[1]) * joint_progress(k / _POSES, 1, first)
        wrist = start[2] + (end[2] - start[2]) * joint_progress(k / _POSES, 2, first)
        head = head_motion(robot, shoulder, arm, wrist, 0.0, 0.0, 0.0)
        least = min(least, spare_clearance(p, head[0], head[1]))
    return least
