"""Changes of the bench's state: one function makes them, only along TRANSITIONS of `bench.base.lifecycle`.

A change that TRANSITIONS does not have is a fault of this program: it stops the bench in the same tick.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import READINGS_LOST, READINGS_VALID, Cause, Phase, Reaction, State
from drivers.base.compiled import compiled

_CALMING = 0.03
"""Time constant of a resting robot's smoothed velocities (s): an encoder's noise alone passes
`rest_speed`."""
_MOVES = 3.0
"""Limit of a velocity before smoothing, in `rest_speed`: rest also shows soon after a fast motion."""


@compiled
def filter_velocity(s: Any, p: Any, e: Any, elapsed: float) -> None:
    """Smooth the estimated velocities (rad/s) on by `elapsed` s; one that is no number counts as motion."""
    for i in range(3):
        most = _MOVES * p.rest_speed[i]
        velocity = min(max(e.velocity[i], -most), most) if np.isfinite(e.velocity[i]) else most
        s.filtered_velocity[i] += elapsed / (elapsed + _CALMING) * (velocity - s.filtered_velocity[i])


@compiled
def is_at_rest(s: Any, p: Any) -> bool:
    """Return whether the robot rests, as far as smoothed velocities show."""
    calm = True
    for i in range(3):
        calm = calm and abs(s.filtered_velocity[i]) <= p.rest_speed[i]
    return calm


@compiled
def is_slow_now(p: Any, e: Any) -> bool:
    """Return whether no joint is faster than `rest_speed`; one whose velocity is no number may be."""
    still = True
    for i in range(3):
        still = still and abs(e.velocity[i]) <= p.rest_speed[i]
    return still


@compiled
def near_address(parameters: Any, estimator: Any) -> bool:
    """Return whether every joint rests at the address within its tolerance."""
    p, e = parameters.control[0], estimator[0]
    for i in range(3):
        if not abs(e.angle[i] - parameters.angle[0, i]) <= p.address_tolerance[i]:
            return False
        if not abs(e.velocity[i]) <= 2.0 * p.rest_speed[i]:
            return False
    return True


@compiled
def begin_reaction(s: Any, parameters: Any, reaction: int, time: float) -> bool:
    """Begin `reaction` unless one as severe is under way; return whether it began.

    A pattern of BLIND_BRAKE belongs to the swing as planned: it brakes all joints, with or without readings.
    After a BRAKE the robot is elsewhere and slower, and the pattern would drive it on. Joints with readings
    then continue to brake by their encoders; the others get centred spools, whose chambers no longer push.
    """
    if reaction <= s.reaction:
        return False
    if reaction == Reaction.BLIND_BRAKE:
        profile, planned = parameters.profile[0], s.reaction != Reaction.BRAKE
        row = s.swing.sample // profile.blind_spacing
        s.blind_row = min(row, profile.blind_rows - 1) if s.swinging and planned else -1
        if planned:
            s.open_loop_joints[0] = s.open_loop_joints[1] = s.open_loop_joints[2] = 1
    elif reaction == Reaction.BRAKE:
        s.open_loop_joints[0] = s.open_loop_joints[1] = s.open_loop_joints[2] = 0
    s.reaction = reaction
    s.reaction_start = s.still_since = time
    return True


@compiled
def change_state(s: Any, parameters: Any, state: State, time: float) -> bool:
    """Go to `state` along TRANSITIONS; else stop with Cause.EXCEPTION in this tick and return False."""
    p = parameters.control[0]
    if s.state < len(p.transitions) and p.transitions[s.state, int(state)] != 0:
        s.state, s.state_since = state, time
        if state in (State.ESTOP, State.FAULT, State.ACCESS):
            s.reset_pressed = -np.inf  # an earlier press does not cover the present cause
        return True
    s.latest_cause = Cause.EXCEPTION
    if s.cause == 0:
        s.cause = Cause.EXCEPTION
    if s.phase == Phase.STANDING:
        s.reaction, s.securing = Reaction.VENT, False
        s.state, s.state_since = State.ESTOP if s.emergency else State.FAULT, time
        s.reset_pressed = -np.inf
    else:
        begin_reaction(s, parameters, p.reactions[s.phase, READINGS_VALID], time)
    return False


@compiled
def resting_state(s: Any) -> State:
    """Return the state of the robot at rest: that of the latched cause, otherwise whether it is homed."""
    if s.cause != 0:
        return State.ESTOP if s.emergency else State.FAULT
    return State.READY if s.homed else State.SAFE


@compiled
def enter_standstill(s: Any, parameters: Any, time: float) -> None:
    """Stand: end whatever was under way, vent, and latch the state of a cause."""
    s.swinging = s.moving = s.disarming = s.air = s.vented = s.venting.emptied = False
    s.phase, s.venting.start = Phase.STANDING, time
    s.venting.empty_since = time
    s.reaction = Reaction.VENT if s.cause != 0 else Reaction.NONE
    change_state(s, parameters, resting_state(s), time)


@compiled
def _note(s: Any, parameters: Any, cause: int) -> bool:
    """Note `cause` as the latest; return whether it is an emergency.

    The first cause lasts, as an open guard does, and is seen in every tick: it hides none found after it.
    """
    before = s.latest_cause
    s.latest_cause = cause
    emergency = bool(parameters.control[0].emergencies[s.latest_cause] != 0)
    if s.latest_cause == s.cause and before != 0:
        s.latest_cause = before
    return emergency


@compiled
def latch(s: Any, parameters: Any, cause: int, time: float) -> None:
    """Latch ESTOP or FAULT while standing; the first cause is kept, unless an emergency comes on top."""
    emergency = _note(s, parameters, cause)
    if s.cause == 0 or (emergency and not s.emergency):
        s.cause = cause
    s.emergency = s.emergency or emergency
    s.reaction, s.securing = Reaction.VENT, False
    change_state(s, parameters, State.ESTOP if s.emergency else State.FAULT, time)


@compiled
def react(state: Any, parameters: Any, cause: int, column: int, time: float) -> None:
    """Enter the table's reaction to `cause`, unless a more severe one is under way."""
    s, p = state.control[0], parameters.control[0]
    s.emergency = _note(s, parameters, cause) or s.emergency
    # A joint far from its reference may as well be an encoder that is stuck.
    misfit = (
        Cause.SHOULDER_FOLLOWING <= cause <= Cause.WRIST_FOLLOWING
        or Cause.SHOULDER_AIR <= cause <= Cause.WRIST_SENSOR
        or Cause.SHOULDER_ZERO <= cause <= Cause.WRIST_ZERO
    )
    s.encoders_suspect = s.encoders_suspect or column == READINGS_LOST or misfit
    if Cause.SHOULDER_INDEX <= cause <= Cause.WRIST_INDEX:
        s.homed = False
    if s.cause == 0:
        s.cause = cause
    if begin_reaction(s, parameters, p.reactions[s.phase, column], time) and s.reaction == Reaction.VENT:
        enter_standstill(s, parameters, time)


@compiled
def disarm(s: Any, parameters: Any, time: float) -> None:
    """Disarm: vent if at rest, otherwise brake first. No cause, nothing is latched."""
    if s.phase in (Phase.HOLD, Phase.STANDING) or not s.air:
        enter_standstill(s, parameters, time)
    elif s.reaction == Reaction.NONE:
        s.moving = False
        begin_reaction(s, parameters, Reaction.BRAKE.value, time)
        if s.state == State.ARMED:
            change_state(s, parameters, State.RECOVERING, time)


@compiled
def enter_hold(s: Any, parameters: Any, time: float) -> None:
    """Hold the address, or vent after a swing that is not followed by another."""
    s.moving = False
    s.phase = Phase.HOLD
    again = parameters.control[0].hold_between_swings and s.lease_held and s.support_ready and not s.disarming
    if s.state == State.ARMED or (again and s.reaction == Reaction.NONE):
        change_state(s, parameters, State.ARMED, time)
    elif s.reaction == Reaction.NONE:
        enter_standstill(s, parameters, time)


@compiled
def latch_exception(control: Any, parameters: Any, time: float) -> None:
    """Latch a tick that failed, in the records `control`: the driver is passive, nothing is under way."""
    s = control[0]
    s.swinging = s.moving = s.disarming = s.air = s.vented = s.venting.emptied = s.tee = False
    s.phase, s.venting.start = Phase.STANDING, time
    s.venting.empty_since = time
    latch(s, parameters, Cause.EXCEPTION.value, time)
    s.reaction = Reaction.PASSIVE
