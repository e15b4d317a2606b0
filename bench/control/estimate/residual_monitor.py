"""Model-based fault detection: comparison of measurements with the predictions of the plant's model.

Five comparisons, each with a limit by phase that fault-free swings stay below:

air       each chamber's pressure against an observer, which knows the valve's command, the motion and the
          supply: a valve that does not follow, a sagging actuator or a wrong pressure sensor
flow      the same, smoothed: a valve that leaks, misses ticks or is off its centre, an encoder that drifts;
          too little to be seen in one tick, and nothing that must be answered within one
velocity  each joint against its reference, which in a swing is the plant model's own prediction: the same,
          seen later, but without pressure sensors
jump      each encoder's sample against the estimator's prediction: steps, garbage, a frozen count
effort    torque from the chambers' pressures against Kane's equations of the measured motion: an encoder
          whose scale or time is wrong, a head that came off

An ABSENT pressure of chamber or supply disables the comparisons that need it. So does an incremental encoder
before its index: without a zero the joint's position and its chambers' volumes are unknown. The model
predicts no shock: a joint or its reference at its shock absorber, or the club's head at ball or turf, at
speed. For a while after a shock the limits of shocks hold where they are wider, and efforts are not compared.
BRAKE has separate limits. All pure, time is an argument.
"""

from __future__ import annotations

from math import cos, sin
from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase, State
from bench.control.envelope import joint_coordinates
from bench.control.estimate.air import actuator_force, actuator_motion, move_spool, needed_torques
from drivers.base.compiled import compiled, fields
from sim.dynamics import chambers, wrist_cylinder

PHASES = len(Phase)
BRAKING = PHASES
"""Row of the limits in BRAKE, plus the phase in which it began."""
SHOCK = 2 * PHASES
"""Row of the limits while a blow counts."""
ARMING = SHOCK + 1
"""Row of the limits on the way to the address, from wherever the robot stood: in the return it comes from a
swing."""
LEARNING = ARMING + 1
"""First row of a second set of limits, for a robot or reference that intentionally differs from the plan."""
KINDS = ("air", "flow", "velocity", "jump", "effort")
"""Names of the comparisons and of their limits."""

MODEL_LIMITS = np.dtype(
    [
        ("check", "?"),
        ("first_row", "i8"),
        *fields("f8", "air flow velocity jump effort", (2 * LEARNING, 3)),
    ],
    align=True,
)
"""Whether to check at all; first row of the limits in force, 0 or LEARNING; limits by row and joint: Pa, Pa,
rad/s, rad, N m. A row is that plus a phase, BRAKING + the phase in which a brake began, SHOCK or ARMING."""

MODEL_STATE = np.dtype(
    [
        ("started", "?"),
        *fields("f8", "spool spool_speed", (3,)),
        *fields("f8", "air rate", (13,)),
        *fields("f8", "measured since residual flow", (6,)),
        ("effort", "f8", (3,)),
        ("settled", "f8"),
        ("pressed", "u1", (6,)),
        ("blow", "f8"),
    ],
    align=True,
)
"""The observer: spools, pressures as `sim.dynamics.chambers` takes them (chambers from 6 on, supply), what
each sensor showed last and for how long (s); residuals of the chambers (Pa; NaN if unknown), the
same smoothed and, smoothed, of the torques (N m); s since the observer began or was disturbed; which joint
and which joint's reference is in its absorber; remaining time of the latest shock (s)."""

_MEMORY = 0.010
"""Time constant with which the observer follows the measured pressures (s)."""
_SETTLING = 0.050
"""Settling time of the observer after its start or a stall of the loop (s)."""
_SMOOTHING = 0.020
"""Time constant of smoothed torques (s): the estimated acceleration is noisy, and late in a jerk."""
_FLOW_SMOOTHING = 0.050
"""Time constant of smoothed chambers (s): long against noise and the shocks of a swing, short against a
swing."""
_BOTH = 0.2
"""Fraction of the limit that the other chamber must also exceed to identify a valve fault."""
_CLOSE = 1e-4
_BLOW = 0.030
"""Time for which a shock shakes all joints (s)."""
_FAST = 0.5
"""Speed above which contact with an absorber is a shock (rad/s)."""
_FAST_HEAD = 3.0
"""Head speed from which ball or turf are a shock (m/s)."""
_NEAR_BALL = (0.08, 0.12)
"""Distances to either side of the ball, and over the turf (m): the head's way in a tick and the ball's
size."""
_NEAR_TURF = 0.010
"""Height over the turf (m)."""
_BRAKED_HEAD = 1.0
"""The same in BRAKE, m/s: a stop past the no-return instant may still strike the ball, slowly, and keeps the
limits of the phase that it began in."""
_BRAKED_NEAR = 0.15
"""Distance to either side of the ball, and over the ground (m)."""


@compiled
def observe(
    m: Any,
    robot: Any,
    plant: Any,
    envelope: Any,
    estimator: Any,
    indexed: Any,
    readings: Any,
    applied: Any,
    reference: Any,
    head: Any,
    vent: float,
    braking: bool,
    step: float,
) -> None:
    """Advance the observer `m` by `step` s under the last valve commands `applied`; set residuals.

    `estimator`, `indexed` (3,) of ENCODER_STATE, `readings` and `head` (6,) of `head_motion` are this tick's,
    `reference` (3,) rad is the last one's; `plant` is the machine's PLANT_PARAMETERS. `vent` is the
    conductance of a chamber's vents (m3/(s Pa)); `braking`: by BRAKE.
    """
    p, e, r = plant[0], estimator[0], readings[0]
    fresh = m.started and 0.0 < step <= 1.5 * p.tick  # after a stall the observer restarts
    m.settled = m.settled + step if fresh else 0.0
    m.air[12] = r.supply_pressure
    for i in range(3):
        move_spool(m, p, applied[i] - p.centre[i], i, 2 * p.substeps)
        position, speed = actuator_motion(robot, p, e.angle, e.velocity, i)
        a, b = 2 * i, 2 * i + 1
        # The flow through open vents is too uncertain to check the chamber pressures.
        known = vent == 0.0 and indexed[i] != 0 and _is_shown(m, r, a) and _is_shown(m, r, b)
        if not (fresh and known and np.isfinite(r.supply_pressure + position + speed)):
            for k in range(a, b + 1):
                m.air[6 + k] = m.measured[k] = r.chamber_pressure[k]
                m.since[k], m.residual[k], m.flow[k] = 0.0, np.nan, 0.0
            continue
        for part in range(2):
            back = position - (0.75 - 0.5 * part) * step * speed
            chambers(p, i, m.air, m.rate, m.spool[i], back, speed, 0.0)
            for k in range(a, b + 1):
                m.air[6 + k] = max(m.air[6 + k] + 0.5 * step * m.rate[6 + k], 0.1 * p.atmosphere)
        for k in range(a, b + 1):
            _compare_chamber(m, r.chamber_pressure[k], k, step)
    m.started = True
    _note_blows(m, robot, p, e, reference, step)
    _note_contact(m, envelope[0], head, braking)
    if fresh:
        _compare_efforts(m, robot, p, e, indexed, step)


@compiled
def _compare_chamber(m: Any, pressure: float, k: int, step: float) -> None:
    """Set chamber `k`'s residuals by the `pressure` (Pa) that its sensor shows; draw the observer to it."""
    m.since[k] += step
    # A sensor may be read less often than the loop runs: only a new value counts.
    if pressure != m.measured[k]:
        m.residual[k] = pressure - m.air[6 + k]
        m.air[6 + k] += m.since[k] / (m.since[k] + _MEMORY) * m.residual[k]
        m.measured[k], m.since[k] = pressure, 0.0
    if np.isfinite(m.residual[k]):
        # Of a sensor that long showed the same, nothing new is known.
        lasting = m.residual[k] if m.since[k] <= _MEMORY else 0.0
        m.flow[k] += step / (step + _FLOW_SMOOTHING) * (lasting - m.flow[k])


@compiled
def _is_shown(m: Any, r: Any, k: int) -> bool:
    """Return whether sensor and observer of chamber `k` both have a finite pressure."""
    # One missing value must not stay in the observer for ever.
    return bool(np.isfinite(r.chamber_pressure[k]) and np.isfinite(m.air[6 + k]))


@compiled
def _note_blows(m: Any, robot: Any, p: Any, e: Any, reference: Any, step: float) -> None:
    """Detect joints, and references, that reach their absorber at speed."""
    m.blow = max(m.blow - step, 0.0) if step > 0.0 else m.blow
    for i in range(3):
        actual, _ = joint_coordinates(robot, e.angle, e.velocity, i)
        wanted, _ = joint_coordinates(robot, reference, e.velocity, i)
        for k, position in ((2 * i, actual), (2 * i + 1, wanted)):
            at_cushion = not p.lower[i] + _CLOSE < position < p.upper[i] - _CLOSE
            if at_cushion and m.pressed[k] == 0 and abs(e.velocity[i]) > _FAST:
                m.blow = _BLOW
            m.pressed[k] = at_cushion


@compiled
def _note_contact(m: Any, envelope: Any, head: Any, braking: bool) -> None:
    """Notice a head that is at the ball or at the turf at speed."""
    along, above = abs(head[0] - envelope.ball_x), head[1] - envelope.ground
    over_turf = above - envelope.sole_depth
    square = head[3] * head[3] + head[4] * head[4]
    at_ball = along < _NEAR_BALL[0] and over_turf < _NEAR_BALL[1]
    if square > _FAST_HEAD * _FAST_HEAD and (at_ball or over_turf < _NEAR_TURF):
        m.blow = _BLOW
    if braking and square > _BRAKED_HEAD * _BRAKED_HEAD and max(along, above) <= _BRAKED_NEAR:
        m.blow = _BLOW


@compiled
def _compare_efforts(m: Any, robot: Any, p: Any, e: Any, indexed: Any, step: float) -> None:
    """Smooth the residuals of Kane's equations (N m); zero for a joint in its absorber, for all in a shock.

    Each equation contains all joint angles: the residuals also stay zero until all encoder zeros are known.
    """
    if indexed[0] == 0 or indexed[1] == 0 or indexed[2] == 0:
        m.effort[0] = m.effort[1] = m.effort[2] = 0.0
        return
    needed, lever = needed_torques(robot, e)
    _, wrist_lever = wrist_cylinder(p, sin(e.angle[2]), cos(e.angle[2]))
    for i in range(3):
        position, speed = actuator_motion(robot, p, e.angle, e.velocity, i)
        to_joint = 1.0 if i == 0 else lever if i == 1 else wrist_lever
        force = actuator_force(p, m.air, i)
        stop = position if i != 2 else e.angle[2]
        residual = needed[i] - (force - p.viscous[i] * speed) * to_joint
        if m.blow > 0.0 or not (p.lower[i] + _CLOSE < stop < p.upper[i] - _CLOSE and np.isfinite(residual)):
            m.effort[i] = 0.0
        else:
            m.effort[i] += step / (step + _SMOOTHING) * (residual - m.effort[i])


@compiled
def row_of(s: Any) -> int:
    """Return the row of the limits for a robot that follows its reference, from the state CONTROL `s`."""
    return ARMING if s.state == State.ARMED and s.phase == Phase.RETURN else int(s.phase)


@compiled
def model_cause(
    limits: Any, m: Any, estimator: Any, reference_velocity: Any, row: int, doubted: int = -1
) -> int:
    """Return the number of the first comparison that exceeds the limits of `row`, or 0.

    A row is a phase, BRAKING + a phase, or ARMING. One chamber of joint `doubted` exceeded its limit earlier:
    it leaks, or its sensor is wrong. A spool fault then needs both chambers beyond the full limit.

    Unknown residuals fail no comparison.
    """
    p, e = limits[0], estimator[0]
    if not p.check or m.settled < _SETTLING:
        return 0
    row += p.first_row
    loosest = p.first_row + SHOCK if m.blow > 0.0 else row
    for i in range(3):
        both = _BOTH if i != doubted else 1.0
        if abs(e.innovation[i]) > max(p.jump[row, i], p.jump[loosest, i]):
            return Cause.SHOULDER_JUMP + i
        air = max(p.air[row, i], p.air[loosest, i])
        a, b = abs(m.residual[2 * i]), abs(m.residual[2 * i + 1])
        if max(a, b) > air:
            # A wrong spool changes the pressures of both chambers, a wrong sensor only one reading.
            return Cause.SHOULDER_AIR + i if min(a, b) > both * air else Cause.SHOULDER_SENSOR + i
        if abs(reference_velocity[i] - e.velocity[i]) > max(p.velocity[row, i], p.velocity[loosest, i]):
            return Cause.SHOULDER_VELOCITY + i
        if abs(m.effort[i]) > max(p.effort[row, i], p.effort[loosest, i]):
            return Cause.SHOULDER_EFFORT + i
        flow = max(p.flow[row, i], p.flow[loosest, i])
        a, b = abs(m.flow[2 * i]), abs(m.flow[2 * i + 1])
        if max(a, b) > flow:
            return Cause.SHOULDER_FLOW + i if min(a, b) > both * flow else Cause.SHOULDER_SENSOR + i
    return 0


@compiled
def note_deviations(largest: Any, m: Any, estimator: Any, reference_velocity: Any, row: int) -> None:
    """Raise `largest` (5, LEARNING, 3), KINDS in order, to what `model_cause` compares in this tick."""
    e = estimator[0]
    if m.settled < _SETTLING:
        return
    if m.blow > 0.0:
        row = SHOCK
    for i in range(3):
        # A comparison with NaN, an unknown value, raises nothing.
        for k in range(2 * i, 2 * i + 2):
            largest[0, row, i] = max(largest[0, row, i], abs(m.residual[k]))
            largest[1, row, i] = max(largest[1, row, i], abs(m.flow[k]))
        largest[2, row, i] = max(largest[2, row, i], abs(reference_velocity[i] - e.velocity[i]))
        largest[3, row, i] = max(largest[3, row, i], abs(e.innovation[i]))
        largest[4, row, i] = max(largest[4, row, i], abs(m.effort[i]))
