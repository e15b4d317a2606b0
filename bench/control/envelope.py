"""The envelope: the one layer between controller and driver that no command bypasses.

`interlock_cause`, `readings_cause` and `motion_cause` return the first cause to stop; `limit` bounds the
valve commands. They use only estimates, readings and the command: pure, compiled, no clock. A value that is
not finite violates its limit; only an ABSENT supply pressure violates none.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase
from drivers.base.compiled import compiled, fields

PHASES = len(Phase)

ENVELOPE_PARAMETERS = np.dtype(
    [
        *fields("f8", "lower upper max_speed", (3,)),
        ("max_following_error", "f8", (PHASES, 3)),
        *fields("f8", "min_deceleration end_stop_max_speed", (3,)),
        *fields("f8", "max_opening max_slew encoder_timeout max_tick_interval spool_tolerance"),
        *fields("f8", "spool_timeout min_supply_pressure max_supply_pressure ground sole_depth clearance"),
        *fields("f8", "ball_x ball_window ball_clearance min_frame_distance min_lever lever_angle"),
    ],
    align=True,
)
"""Limits in joint coordinates (theta1 rad, rod extension m, theta3 rad): working range, speeds (rad/s, m/s,
rad/s), following error per phase (rad), guaranteed deceleration of a brake and the speed that the absorber
stops alone; valve command and its slew rate (1/s); time without a reading that counts as lost (s); longest
tick while moving (s); deviation of a measured spool from its model, its time (s); supply (Pa); ground line,
depth of the sole below the face centre, clearances outside and inside the ball's window (m); distance of the
club from the shoulder axis (m); min |sin beta| of the wrist, and the mounting angle of its lever (rad)."""


@compiled
def joint_coordinates(robot: Any, angle: Any, velocity: Any, i: int) -> tuple[float, float]:
    """Return position and speed of joint coordinate `i`: theta1, rod extension (m, m/s), theta3."""
    r = robot[0]
    if i != 1:
        return angle[i], velocity[i]
    dx, dy = r.l62 + r.l23 * cos(angle[1]), r.l23 * sin(angle[1])
    length = sqrt(dx * dx + dy * dy)
    return length - r.l56, -r.l62 * r.l23 * sin(angle[1]) / length * velocity[1]


@compiled
def interlock_cause(readings: Any) -> int:
    """Return the interlock that forbids motion now, or 0."""
    r = readings[0]
    if not r.emergency_stop_clear:
        return Cause.EMERGENCY_STOP
    if not (r.guard_closed and r.guard_locked):
        return Cause.GUARD
    return 0


@compiled
def relay_closed(readings: Any) -> bool:
    """Return whether the safety relay closes the coil circuit of vents and shut-off valve, as read."""
    return bool(readings[0].emergency_stop_clear and readings[0].guard_closed)


@compiled
def readings_cause(parameters: Any, estimator: Any) -> int:
    """Return the cause that makes the joint readings untrustworthy, or 0."""
    p, e = parameters[0], estimator[0]
    for i in range(3):
        if e.started[i] == 0 or not e.without_sample[i] < p.encoder_timeout:
            return Cause.SHOULDER_ENCODER + i
        if not np.isfinite(e.angle[i] + e.velocity[i] + e.acceleration[i]):
            return Cause.NOT_FINITE
    return 0


@compiled
def motion_cause(
    parameters: Any,
    robot: Any,
    estimator: Any,
    readings: Any,
    reference: Any,
    phase: int,
    measured_step: float,
    charging: bool,
    low: float = 0.0,
) -> int:
    """Return the first limit of motion that is broken in `phase`, or 0; readings are trusted here.

    While `charging` the supply may still be rising. A supply pressure that is ABSENT breaks nothing. The head
    may be nearer to the ground by `low` (m).
    """
    p, e = parameters[0], estimator[0]
    angle, velocity = e.angle, e.velocity
    if not 0.0 <= measured_step <= p.max_tick_interval:
        return Cause.TICK_GAP
    # Past the no-return instant stopping sooner than planned helps neither a sagging supply nor a short way.
    stoppable = phase <= Phase.DOWNSWING or phase == Phase.RETURN
    supply = readings[0].supply_pressure
    if stoppable and ((not charging and supply < p.min_supply_pressure) or supply > p.max_supply_pressure):
        return Cause.SUPPLY_PRESSURE
    for i in range(3):
        position, speed = joint_coordinates(robot, angle, velocity, i)
        if not (p.lower[i] <= position <= p.upper[i]):
            return Cause.SHOULDER_RANGE + i
        if not abs(speed) <= p.max_speed[i]:
            return Cause.SHOULDER_SPEED + i
        if stoppable:
            way = (p.upper[i] - position) if speed > 0.0 else (position - p.lower[i])
            if (
                not speed * speed
                <= p.end_stop_max_speed[i] * p.end_stop_max_speed[i] + 2.0 * p.min_deceleration[i] * way
            ):
                return Cause.SHOULDER_STOP_DISTANCE + i
        # The jump of the impact is in no reference.
        if phase != Phase.IMPACT and not abs(reference[i] - angle[i]) <= p.max_following_error[phase, i]:
            return Cause.SHOULDER_FOLLOWING + i
    return _clearance_cause(p, robot, angle, low)


@compiled
def clearance_needed(p: Any, head_x: float) -> float:
    """Return the least height (m) of the sole over the ground where the face is at `head_x` (m)."""
    needed: float = p.ball_clearance if abs(head_x - p.ball_x) <= p.ball_window else p.clearance
    return needed


@compiled
def spare_clearance(p: Any, head_x: float, head_y: float) -> float:
    """Return by how much (m) the sole is higher than it has to be, the face at `head_x`, `head_y` (m)."""
    return float(head_y - p.sole_depth - p.ground - clearance_needed(p, head_x))


@compiled
def _clearance_cause(p: Any, robot: Any, angle: Any, low: float) -> int:
    """Return the cause if the club is too near to ground (`low` m more), frame, or the wrist's dead point."""
    r = robot[0]
    a1 = angle[0]
    a12 = a1 + angle[1]
    theta = a12 + angle[2]
    wrist_x, wrist_y = r.l12 * cos(a1) + r.l23 * cos(a12), r.l12 * sin(a1) + r.l23 * sin(a12)
    along_x, along_y = cos(theta), sin(theta)
    head_x, head_y = wrist_x + r.l3t * along_x, wrist_y + r.l3t * along_y
    if not spare_clearance(p, head_x, head_y) >= -low:
        return Cause.GROUND
    # Nearest point of the club to the shoulder axis.
    nearest = min(max(-(wrist_x * along_x + wrist_y * along_y), 0.0), r.l3t)
    x, y = wrist_x + nearest * along_x, wrist_y + nearest * along_y
    if not x * x + y * y >= p.min_frame_distance * p.min_frame_distance:
        return Cause.FRAME
    if not abs(sin(angle[2] + p.lever_angle - 1.5 * np.pi)) >= p.min_lever:
        return Cause.WRIST_LEVER
    return 0


@compiled
def limit(parameters: Any, wanted: float, before: float, measured_step: float) -> float:
    """Return the valve command within range and slew limit; 0 if `wanted` is not finite.

    While the clock stands still, runs backwards or is not finite, the command keeps its value `before`.
    """
    p = parameters[0]
    if not np.isfinite(wanted):
        return 0.0
    step = p.max_slew * measured_step if measured_step > 0.0 else 0.0
    bounded = min(max(wanted, -p.max_opening), p.max_opening)
    opening: float = min(max(bounded, before - step), before + step)
    return opening
