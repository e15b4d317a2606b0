"""The deciding part of the cycle: one compiled function from readings to command.

`step` estimates (`estimate_tick`), answers requests, moves the swing on, computes reference, PID and
feed-forward, asks the envelope, picks the reaction from the stopping table, moves the bench from state to
state (`decide_tick`) and limits the command (`limit_tick`). It reads no clock, allocates nothing, raises
nothing; all it remembers is in the records of `ControlState`. The same functions run in the real-time loop,
which takes the time of each, in lock-step simulation and in sweeps.
"""

from __future__ import annotations

from math import floor, sqrt
from typing import Any, NamedTuple

import numpy as np

from bench.control.air import AIR_STATE, actuator_motion, observe_air
from bench.control.encoder import ENCODER_STATE, decode_encoders
from bench.control.envelope import interlock_cause, limit, motion_cause, readings_cause
from bench.control.estimator import ESTIMATOR_STATE, estimate
from bench.control.feed_forward import KANE, NONE, PNEUMATIC, pneumatic_opening
from bench.control.homing import begin_search, bounded, search, search_cause
from bench.control.model import MODEL_STATE, model_cause, observe
from bench.control.pid import PID_STATE, control, reset_integral
from bench.control.requests import near_address, note_local_reset, take_request
from bench.lifecycle import (
    DISOBEYED,
    DOUBTED,
    EMERGENCY,
    LOST,
    TRUSTED,
    WRIST_DISOBEYED,
    Answer,
    Cause,
    Phase,
    Reaction,
    Request,
    State,
)
from drivers.base.compiled import compiled, new_record
from sim.kinematics import head_motion

ARM, SWING, DISARM = int(Request.ARM), int(Request.SWING), int(Request.DISARM)
RESET, STOP = int(Request.RESET), int(Request.STOP)
"""Requests, put into `state.control.request` before a tick; the step answers in `answer`."""

ACCEPTED, REFUSED = int(Answer.ACCEPTED), int(Answer.REFUSED)

CONTROL_PARAMETERS = np.dtype(
    [
        ("damping", "f8", (3,)),
        ("downswing_damping", "f8"),
        ("dither", "f8", (3,)),
        ("dither_period", "f8"),
        ("dither_delay", "f8"),
        ("move_gain", "f8", (3,)),
        ("brake_gain", "f8", (3,)),
        ("brake_damping", "f8", (3,)),
        ("brake_fade", "f8", (3,)),
        ("feed_forward", "u1"),
        ("force_gain", "f8", (3,)),
        ("rate_opening", "f8", (3,)),
        ("speed_opening", "f8", (3,)),
        ("still_speed", "f8", (3,)),
        ("still_time", "f8"),
        ("brake_time", "f8"),
        ("blind_settle", "f8"),
        ("precharge_time", "f8"),
        ("precharge_opening", "f8"),
        ("precharge_period", "f8"),
        ("move_speed", "f8", (3,)),
        ("move_timeout", "f8"),
        ("address_tolerance", "f8", (3,)),
        ("rest_band", "f8", (3,)),
        ("strike_drop", "f8"),
        ("reactions", "u1", (len(Phase), 6)),
        ("accepted", "u1", (len(Request), len(State))),
        ("needs_lease", "u1", (len(Request),)),
        ("emergencies", "u1", (len(Cause),)),
        ("warning_time", "f8"),
        ("armed_time", "f8"),
        ("vented_pressure", "f8"),
        ("vent_time", "f8"),
        ("vented_still", "f8"),
        ("vented_blind", "f8"),
        ("local_reset", "?"),
        ("local_reset_time", "f8"),
        ("series", "?"),
        ("read_only", "?"),
        ("home_by_index", "?"),
        ("home_pose", "f8", (3,)),
        ("home_tolerance", "f8", (3,)),
        ("home_time", "f8"),
        ("home_order", "i8", (3,)),
        ("home_direction", "f8", (3,)),
        ("home_travel", "f8", (3,)),
        ("home_speed", "f8", (3,)),
        ("home_opening", "f8"),
        ("home_longest", "f8"),
    ],
    align=True,
)
"""Gains and times. `damping` opens the valve against the estimated acceleration (per rad/s2): the air's
spring has hardly any damping of its own, and position and velocity feedback cannot add it.
`downswing_damping` is the share of it left in the downswing, `dither` swings the spools around what is wanted
of them up to the top. `feed_forward` is a code of `bench.control.feed_forward`,
`rate_opening` and `speed_opening` are its `kane_gains`. `move_gain` is the
opening per rad/s of reference speed in slow moves; `brake_gain`, `brake_damping` are the BRAKE law's."""

CONTROL_STATE = np.dtype(
    [
        ("tick", "i8"),
        ("time", "f8"),
        ("measured_step", "f8"),
        ("started", "?"),
        ("lost", "i4"),
        ("distrusted", "?"),
        ("seen", "?"),
        ("request", "u1"),
        ("request_number", "i8"),
        ("lease_held", "?"),
        ("support_ready", "?"),
        ("supervisor_alive", "?"),
        ("device_operational", "?"),
        ("warm", "?"),
        ("first_cause", "i4"),
        ("asked", "u1"),
        ("answered_number", "i8"),
        ("answer", "u1"),
        ("refusal", "u1"),
        ("state", "u1"),
        ("state_since", "f8"),
        ("emergency", "?"),
        ("homed", "?"),
        ("home_good", "f8"),
        ("home_begin", "f8"),
        ("home_turn", "i8"),
        ("home_since", "f8"),
        ("home_from", "f8", (3,)),
        ("zero_shift", "f8", (3,)),
        ("vented", "?"),
        ("vent_start", "f8"),
        ("air", "?"),
        ("air_from", "f8"),
        ("securing", "?"),
        ("disarming", "?"),
        ("reset_was_low", "?"),
        ("reset_pressed", "f8"),
        ("tee", "?"),
        ("phase", "u1"),
        ("reaction", "u1"),
        ("cause", "i4"),
        ("latest_cause", "i4"),
        ("swinging", "?"),
        ("swing_start", "f8"),
        ("swing_sample", "i8"),
        ("moving", "?"),
        ("move_start", "f8"),
        ("move_time", "f8"),
        ("move_from", "f8", (3,)),
        ("reaction_start", "f8"),
        ("blind_row", "i8"),
        ("still_since", "f8"),
        ("reference", "f8", (3,)),
        ("reference_velocity", "f8", (3,)),
        ("reference_acceleration", "f8", (3,)),
        ("feed_forward", "f8", (3,)),
        ("desired", "f8", (3,)),
        ("applied", "f8", (3,)),
        ("head", "f8", (6,)),
        ("fastest_head", "f8"),
        ("struck", "?"),
        ("swings", "i8"),
    ],
    align=True,
)
"""From outside, before a tick: `request`, `request_number`, `lease_held`, `support_ready`,
`supervisor_alive`, `device_operational`, `warm` (STARTING is over), `first_cause` (of the ESTOP after it),
`tee`.
`zero_shift` is what a zero that was set in this tick added to the joint's angle (rad).
`lost` is this tick's verdict on the readings, `distrusted` that since the last reset they were found wrong or
did not fit the model, `seen` that they were trusted once; `emergency` says that the stop under way ends in
ESTOP; `air` that the supply is on."""

PROFILE = np.dtype(
    [
        ("samples", "i8"),
        ("period", "f8"),
        ("blind_spacing", "i8"),
        ("blind_rows", "i8"),
    ],
    align=True,
)

_HOLD, _RETURN, _STANDING = int(Phase.HOLD), int(Phase.RETURN), int(Phase.STANDING)
_SEARCH = int(Phase.HOMING)
_BACKSWING, _TOP = int(Phase.BACKSWING), int(Phase.TOP)
_DOWN, _COMMITTED = int(Phase.DOWNSWING), int(Phase.COMMITTED)
_IMPACT, _FOLLOW = int(Phase.IMPACT), int(Phase.FOLLOW_THROUGH)
_NONE, _COMPLETE, _BRAKE = int(Reaction.NONE), int(Reaction.COMPLETE), int(Reaction.BRAKE)
_BLIND, _PASSIVE, _VENT = int(Reaction.BLIND_BRAKE), int(Reaction.PASSIVE), int(Reaction.VENT)
_E_STOP_CAUSE, _OPERATOR = int(Cause.EMERGENCY_STOP), int(Cause.OPERATOR_STOP)
_FOLLOWING, _ADDRESS_TIMEOUT = int(Cause.SHOULDER_FOLLOWING), int(Cause.ADDRESS_TIMEOUT)
_AIR, _JUMP = int(Cause.SHOULDER_AIR), int(Cause.SHOULDER_JUMP)
_FLOW, _SENSOR = int(Cause.SHOULDER_FLOW), int(Cause.SHOULDER_SENSOR)
_TICK_GAP = int(Cause.TICK_GAP)
_NETWORK, _SUPERVISOR, _HOMING_FAILED = (
    int(Cause.NETWORK_STOP), int(Cause.SUPERVISOR), int(Cause.HOMING_FAILED),
)  # fmt: skip
_GUARD_CAUSE, _NOT_VENTED, _ENCODER, _DEVICE = (
    int(Cause.GUARD), int(Cause.NOT_VENTED), int(Cause.SHOULDER_ENCODER), int(Cause.DEVICE_PASSIVE),
)  # fmt: skip
_ARM, _SWING, _DISARM, _RESET = ARM, SWING, DISARM, RESET
_STOP, _EMERGENCY_STOP, _HOME = STOP, int(Request.EMERGENCY_STOP), int(Request.HOME)
_ACCESS, _SECURE, _TEE = int(Request.ACCESS), int(Request.SECURE), int(Request.TEE)
_STARTING, _ESTOP, _SAFE, _HOMING = int(State.STARTING), int(State.ESTOP), int(State.SAFE), int(State.HOMING)
_READY, _ARMED, _SWINGING = int(State.READY), int(State.ARMED), int(State.SWINGING)
_RECOVERING, _IN_ACCESS, _FAULT = int(State.RECOVERING), int(State.ACCESS), int(State.FAULT)

_SECURING_TIME = 2.0
"""In which a guard that is to be locked must be seen locked, s."""


class ControlState(NamedTuple):
    """All that the step remembers, as records it changes in place."""

    control: Any
    encoder: Any
    estimator: Any
    pid: Any
    model: Any
    """Of the model-based check."""
    air: Any
    """Of the chamber-pressure observer; moved on only where the feed-forward takes it."""


class ControlParameters(NamedTuple):
    """All that the step is told beforehand: records and the profile's tables."""

    control: Any
    encoder: Any
    estimator: Any
    pid: Any
    envelope: Any
    model: Any
    robot: Any
    plant: Any
    """The machine's data for the model-based check."""
    profile: Any
    angle: Any
    """(n, 3) rad, reference at the profile's period."""
    velocity: Any
    valve: Any
    phase: Any
    """(n,) Phase of each sample."""
    force: Any
    """(n, 3) demanded of the actuators, N, shoulder N m; zeros where the feed-forward does not take it."""
    force_rate: Any
    """(n, 3) N/s, N m/s"""
    blind_brake: Any
    """(m, 6) openings and durations (s)."""


def new_control_state(state: State = State.READY) -> ControlState:
    """Return the state at power-up: standing, nothing read yet.

    A simulation begins in READY, homed and with the lease; a bench begins in State.STARTING.
    """
    made = ControlState(
        new_record(CONTROL_STATE),
        new_record(ENCODER_STATE),
        new_record(ESTIMATOR_STATE),
        new_record(PID_STATE),
        new_record(MODEL_STATE),
        new_record(AIR_STATE),
    )
    control, begun = made.control, state != State.STARTING
    control["state"], control["first_cause"] = state, Cause.POWER_UP
    control["homed"] = begun and state != State.SAFE
    for name in ("lease_held", "support_ready", "supervisor_alive"):
        control[name] = begun
    control["device_operational"] = True
    control["reset_pressed"] = control["vent_start"] = control["still_since"] = -np.inf
    return made


@compiled
def _profile_at(parameters: Any, s: Any, time: float) -> bool:
    """Set reference, feed-forward and phase of the swing at `time`; return False once it is over."""
    profile = parameters.profile[0]
    # A ten-millionth of a sample guards the floor against rounding of exact ticks.
    sample = (time - s.swing_start) / profile.period + 1e-7
    if not sample >= 0.0:  # a clock that runs backwards, or is none, does not lead out of the tables
        sample = 0.0
    last = profile.samples - 1
    over = sample >= last
    if over:
        k, part = last - 1, 1.0
    else:
        k = floor(sample)
        part = max(sample - k - 1e-7, 0.0)
    s.swing_sample = min(k + 1, last) if over else k
    angle, velocity, valve = parameters.angle, parameters.velocity, parameters.valve
    for i in range(3):
        change = velocity[k + 1, i] - velocity[k, i]
        s.reference[i] = angle[k, i] + part * (angle[k + 1, i] - angle[k, i])
        s.reference_velocity[i] = velocity[k, i] + part * change
        s.reference_acceleration[i] = change / profile.period
        s.feed_forward[i] = valve[k, i] + part * (valve[k + 1, i] - valve[k, i])
    s.phase = parameters.phase[s.swing_sample]
    return not over


@compiled
def _begin_move(parameters: Any, s: Any, start: Any, time: float) -> None:
    """Begin a slow move from angles `start` to the address (the profile's first sample)."""
    p = parameters.control[0]
    s.move_time = 0.3
    for i in range(3):
        s.move_from[i] = start[i]
        # A quintic's greatest speed is 15/8 of its mean.
        s.move_time = max(s.move_time, 1.875 * abs(parameters.angle[0, i] - start[i]) / p.move_speed[i])
    s.move_start = time
    s.moving = True
    s.phase = _RETURN


@compiled
def _move_at(parameters: Any, s: Any, time: float) -> bool:
    """Set the reference of the slow move at `time` (quintic: rest to rest); return False once it is over."""
    p = parameters.control[0]
    part = min(max((time - s.move_start) / s.move_time, 0.0), 1.0)
    shape = part * part * part * (10.0 - 15.0 * part + 6.0 * part * part)
    slope = 30.0 * part * part * (1.0 - part) * (1.0 - part) / s.move_time
    bend = 60.0 * part * (1.0 - part) * (1.0 - 2.0 * part) / (s.move_time * s.move_time)
    for i in range(3):
        way = parameters.angle[0, i] - s.move_from[i]
        s.reference[i] = s.move_from[i] + way * shape
        s.reference_velocity[i] = way * slope
        s.reference_acceleration[i] = way * bend
        s.feed_forward[i] = p.move_gain[i] * way * slope
    return bool(part < 1.0)


@compiled
def _note_impact(p: Any, s: Any) -> None:
    """Notice the drop of head speed that only a struck ball gives; no drop seen is the event 'no ball'."""
    speed = sqrt(s.head[3] * s.head[3] + s.head[4] * s.head[4])
    if s.phase == _IMPACT:
        s.fastest_head = max(s.fastest_head, speed)
        if speed < (1.0 - p.strike_drop) * s.fastest_head:
            s.struck = True


@compiled
def _enter(s: Any, state: int, time: float) -> None:
    """Go to `state`."""
    s.state, s.state_since = state, time


@compiled
def _stand(s: Any, time: float) -> None:
    """Be at rest: whatever was under way is over, the air is let out, and a cause latches its state."""
    s.swinging = s.moving = s.disarming = s.air = s.vented = False
    s.phase, s.vent_start = _STANDING, time
    if s.cause != 0:
        s.reaction = _VENT
        _enter(s, _ESTOP if s.emergency else _FAULT, time)
    else:
        s.reaction = _NONE
        _enter(s, _READY if s.homed else _SAFE, time)


@compiled
def _latch(p: Any, s: Any, cause: int, time: float) -> None:
    """Latch ESTOP or FAULT while standing; the first cause is kept, unless an emergency comes on top."""
    emergency = p.emergencies[cause] != 0
    s.latest_cause = cause
    if s.cause == 0 or (emergency and not s.emergency):
        s.cause = cause
    s.emergency = s.emergency or emergency
    s.reaction, s.securing = _VENT, False
    _enter(s, _ESTOP if s.emergency else _FAULT, time)


@compiled
def _react(state: Any, parameters: Any, cause: int, column: int, time: float) -> None:
    """Enter the table's reaction to `cause`, unless a more severe one is under way."""
    s, p = state.control[0], parameters.control[0]
    s.latest_cause = cause
    s.emergency = s.emergency or p.emergencies[cause] != 0
    s.distrusted = s.distrusted or column == LOST or cause >= _AIR
    if s.cause == 0:
        s.cause = cause
    reaction = p.reactions[s.phase, column]
    if reaction <= s.reaction:
        return
    s.reaction = reaction
    s.reaction_start = time
    s.still_since = time
    if reaction == _BLIND:
        profile = parameters.profile[0]
        row = s.swing_sample // profile.blind_spacing
        s.blind_row = min(row, profile.blind_rows - 1) if s.swinging else -1
    if reaction == _VENT:
        _stand(s, time)


@compiled
def _disarm(s: Any, time: float) -> None:
    """Let go in order: vent when at rest, else brake first. No cause, nothing is latched."""
    if s.phase in (_HOLD, _STANDING) or not s.air:
        _stand(s, time)
    elif s.reaction == _NONE:
        s.reaction, s.moving = _BRAKE, False
        s.reaction_start = s.still_since = time
        if s.state == _ARMED:
            _enter(s, _RECOVERING, time)


@compiled
def _carry_out(state: Any, parameters: Any, request: int, time: float) -> None:
    """Do what the accepted `request` asks for; stops are not done here."""
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    if request == _RESET:
        s.cause = s.latest_cause = 0
        s.emergency = s.distrusted = False
        s.reaction, s.reset_pressed = _NONE, -np.inf
        _enter(s, _READY if s.homed else _SAFE, time)
    elif request == _HOME:
        s.homed, s.home_good = False, time
        if p.home_by_index:
            reset_integral(state.pid)
            s.disarming = s.tee = False
            s.air_from = time + p.warning_time
            s.move_start = s.home_begin = s.air_from + p.precharge_time
            begin_search(s, p, e.angle, s.move_start)
            s.phase = _SEARCH
        _enter(s, _HOMING, time)
    elif request == _ARM:
        reset_integral(state.pid)
        s.disarming = s.tee = False
        s.air_from = time + p.warning_time
        # Set-point := measured; the move begins when the chambers are charged.
        _begin_move(parameters, s, e.angle, s.air_from + p.precharge_time)
        _enter(s, _ARMED, time)
    elif request == _SWING:
        s.swinging, s.swing_start, s.struck, s.fastest_head = True, time, False, 0.0
        s.swings += 1
        _profile_at(parameters, s, time)
        # The integrals go on: the output of this tick also holds the damping term's noise.
        _enter(s, _SWINGING, time)
    elif request == _DISARM:
        if s.state == _RECOVERING:
            s.disarming = True  # the return is the safe way home; then nothing stays armed
        else:
            _disarm(s, time)
    elif request == _ACCESS:
        s.securing = False
        _enter(s, _IN_ACCESS, time)
    elif request == _SECURE:
        s.securing, s.state_since = True, time
    elif request == _TEE:
        s.tee = True


@compiled
def _watch_vent(p: Any, s: Any, e: Any, readings: Any, time: float) -> bool:
    """Judge whether the chambers are empty; return True when they should be and are not.

    A raised arm hangs on what little air is left and then sinks: before anybody goes near, it has to rest
    for a while with empty chambers. Where the encoders cannot tell, for as long as sinking may take.
    """
    fitted = empty = True
    blind = s.lost != 0 or s.distrusted
    for i in range(6):
        pressure = readings[0].chamber_pressure[i]
        if not np.isfinite(pressure):
            fitted = False
        elif pressure > p.vented_pressure:
            empty = False
    still = empty
    for i in range(3):
        if not blind and abs(e.velocity[i]) > p.still_speed[i]:
            still = False
    if not still:
        s.still_since = time
    wait = p.vented_blind if blind else p.vented_still
    rests = time - s.still_since >= wait or s.state == _IN_ACCESS
    late = time - s.vent_start >= p.vent_time
    s.vented = empty and rests and (fitted or late)
    return late and not empty


@compiled
def _watch_homing(state: Any, parameters: Any, readings: Any, time: float) -> None:
    """Compare absolute encoders with the vented robot's pose; nothing moves."""
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    good = True
    for i in range(3):
        good = good and abs(e.angle[i] - p.home_pose[i]) <= p.home_tolerance[i]
        good = good and readings[0].encoder_indexed[i] != 0
    if not good:
        s.home_good = time
    if time - s.home_good >= p.home_time:
        s.homed = True
        _enter(s, _READY, time)
    elif time - s.state_since >= 2.0 * p.home_time:
        _latch(p, s, _HOMING_FAILED, time)


@compiled
def _watch_standing(
    state: Any, parameters: Any, readings: Any, interlock: int, asked: int, time: float
) -> None:
    """Latch what must not be while the robot stands, and move on the states in which it does."""
    s, p = state.control[0], parameters.control[0]
    pressed = _watch_vent(p, s, state.estimator[0], readings, time)
    jumped = model_cause(parameters.model, state.model[0], state.estimator, s.reference_velocity, _STANDING)
    for i in range(3):
        if readings[0].encoder_valid[i] != 0 and readings[0].encoder_indexed[i] == 0:
            s.homed = False
    if s.state == _STARTING:
        if s.warm:
            _latch(p, s, s.first_cause, time)
        return
    if interlock == _E_STOP_CAUSE or asked == _NETWORK:
        if s.state != _ESTOP:
            _latch(p, s, interlock if interlock == _E_STOP_CAUSE else asked, time)
        return
    if s.state in (_ESTOP, _FAULT):
        return
    if not s.supervisor_alive or not s.device_operational:
        _latch(p, s, _DEVICE if s.supervisor_alive else _SUPERVISOR, time)
    elif s.state == _IN_ACCESS:
        if not s.vented:
            _latch(p, s, _NOT_VENTED, time)
        elif s.securing and interlock == 0:
            s.securing = False
            if s.cause != 0:
                _enter(s, _ESTOP if s.emergency else _FAULT, time)
            else:
                _enter(s, _READY if s.homed else _SAFE, time)
        elif s.securing and time - s.state_since >= _SECURING_TIME:
            _latch(p, s, _GUARD_CAUSE, time)
    elif interlock != 0:
        _latch(p, s, interlock, time)
    elif asked != 0 and s.state == _HOMING:
        _latch(p, s, asked, time)
    elif s.lost != 0 and s.seen and s.state != _SAFE:
        _latch(p, s, s.lost, time)
    elif s.state == _READY and jumped != 0:
        s.homed, s.distrusted = False, True  # whatever turned there, it was not the joint
        _latch(p, s, jumped, time)
    elif pressed:
        _latch(p, s, _NOT_VENTED, time)
    elif s.state == _READY and not s.homed:
        _enter(s, _SAFE, time)
    elif s.state == _HOMING:
        if not s.lease_held:
            _disarm(s, time)
        else:
            _watch_homing(state, parameters, readings, time)


@compiled
def _watch_permission(s: Any, p: Any, time: float) -> None:
    """Disarm when nobody holds the bench any more, nothing would be recorded, or it waited for too long."""
    if s.state == _ARMED and s.reaction == _NONE:
        waited = s.phase == _HOLD and time - s.state_since > p.armed_time
        if waited or not (s.lease_held and s.support_ready):
            _disarm(s, time)
    elif s.state == _HOMING and s.reaction == _NONE and not s.lease_held:
        _disarm(s, time)
    elif s.state in (_SWINGING, _RECOVERING) and not (s.lease_held and s.support_ready):
        s.disarming = True  # also if both come back: nothing is armed again by itself


@compiled
def brake_opening(gain: float, damping: float, fade: float, velocity: float, acceleration: float) -> float:
    """Return the opening that brakes a joint: air against the motion, eased off as it slows down.

    The same law brakes the planned follow-through, with or without a ball, and every stop.
    """
    # Eased off towards rest, where the air's spring would make a stiff law swing for ever.
    share = min(abs(velocity) / fade, 1.0)
    return -share * (gain * velocity + damping * acceleration)


@compiled
def _brake_openings(s: Any, p: Any, e: Any) -> None:
    """Set the openings that brake."""
    for i in range(3):
        s.desired[i] = brake_opening(
            p.brake_gain[i], p.brake_damping[i], p.brake_fade[i], e.velocity[i], e.acceleration[i]
        )


@compiled
def _rest_or_wait(s: Any, p: Any, e: Any, trusted: bool, time: float) -> None:
    """End a stop once all joints have rested for long enough, or its time is up."""
    still = trusted
    for i in range(3):
        still = still and abs(e.velocity[i]) <= p.still_speed[i]
    if not still:
        s.still_since = time
    if time - s.still_since >= p.still_time or time - s.reaction_start >= p.brake_time:
        _stand(s, time)


@compiled
def _brake(state: Any, parameters: Any, trusted: bool, time: float) -> None:
    """Set the desired openings of BRAKE: air against the motion, until all joints rest."""
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    _brake_openings(s, p, e)
    for i in range(3):
        s.reference[i], s.reference_velocity[i], s.feed_forward[i] = e.angle[i], 0.0, 0.0
    _rest_or_wait(s, p, e, trusted, time)


@compiled
def _go_limp(state: Any, parameters: Any, trusted: bool, time: float) -> None:
    """Wait in PASSIVE until all joints rest: spools centred, supply shut, vents opening by their timer."""
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    for i in range(3):
        s.desired[i] = s.feed_forward[i] = s.reference_velocity[i] = 0.0
        s.reference[i] = e.angle[i]
    _rest_or_wait(s, p, e, trusted, time)


@compiled
def _brake_blind(s: Any, parameters: Any, time: float) -> None:
    """Set the desired openings of BLIND_BRAKE: the profile's pattern, by time alone."""
    since = time - s.reaction_start
    longest = 0.0
    for i in range(3):
        s.desired[i] = s.feed_forward[i] = 0.0
        if s.blind_row >= 0:
            duration = parameters.blind_brake[s.blind_row, 3 + i]
            longest = max(longest, duration)
            if since < duration:
                s.desired[i] = parameters.blind_brake[s.blind_row, i]
    if since >= longest + parameters.control[0].blind_settle:
        _stand(s, time)


@compiled
def _arrive(s: Any, p: Any, time: float) -> None:
    """Be at the address: hold it, or vent after a swing that is not followed by another."""
    s.moving = False
    s.phase = _HOLD
    again = p.series and s.lease_held and s.support_ready and not s.disarming
    if s.state == _ARMED or (again and s.reaction == _NONE):
        _enter(s, _ARMED, time)
    elif s.reaction == _NONE:
        _stand(s, time)


@compiled
def _follow(state: Any, parameters: Any, time: float, measured_step: float) -> None:
    """Move the swing, the slow move or the hold on and compute the desired openings."""
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    if s.swinging:
        if not _profile_at(parameters, s, time):
            s.swinging = s.tee = False
            if s.reaction == _COMPLETE:
                s.reaction = _BRAKE  # the planned braking is done; BRAKE holds until rest is proven
                s.reaction_start = s.still_since = time
            else:
                reset_integral(state.pid)
                _begin_move(parameters, s, e.angle, time)
                _move_at(parameters, s, time)
                _enter(s, _RECOVERING, time)
    elif s.phase == _SEARCH:
        indexed = state.encoder[0].indexed
        if search(s, p, e.angle, indexed, s.zero_shift, time, measured_step):
            s.homed = True
            s.reaction = _BRAKE  # no cause: to rest, then READY
            s.reaction_start = s.still_since = time
    elif s.moving:
        if not _move_at(parameters, s, time) and near_address(parameters, state.estimator):
            _arrive(s, p, time)
    else:
        for i in range(3):
            # Near enough is left alone: with dry friction an integral would hunt for ever.
            away = parameters.angle[0, i] - e.angle[i]
            s.reference[i] = parameters.angle[0, i] if abs(away) > p.rest_band[i] else e.angle[i]
            s.reference_velocity[i] = s.reference_acceleration[i] = s.feed_forward[i] = 0.0
    if s.phase == _FOLLOW:
        _brake_openings(s, p, e)
        return
    if s.swinging and p.feed_forward >= KANE:
        _feed_model_forward(state, parameters, time)
    for i in range(3):
        if p.feed_forward == NONE:
            s.feed_forward[i] = 0.0
        # The impact's jump is no motion to be damped.
        if s.phase != _IMPACT:
            share = p.downswing_damping if s.phase in (_DOWN, _COMMITTED) else 1.0
            s.feed_forward[i] += share * p.damping[i] * (s.reference_acceleration[i] - e.acceleration[i])
    control(
        state.pid, parameters.pid, s.reference, s.reference_velocity, e.angle, e.velocity, s.feed_forward,
        measured_step,
    )  # fmt: skip
    push = side = 0.0
    if _charging(s, time):
        # A closed-centre spool fills one chamber while it empties the other. Swung around the centre it
        # passes as much in as out of both, which ends at about three quarters of the supply in each.
        push = p.precharge_opening * _side((time - s.move_start) / p.precharge_period)
    elif s.phase in (_BACKSWING, _TOP) and time - s.swing_start >= p.dither_delay:
        side = _side((time - s.swing_start) / p.dither_period)
    for i in range(3):
        s.desired[i] = state.pid[0].output[i] + push + side * p.dither[i]


@compiled
def _feed_model_forward(state: Any, parameters: Any, time: float) -> None:
    """Set the feed-forward of the swing at `time` from the demanded forces, not the planned openings."""
    s, p, profile = state.control[0], parameters.control[0], parameters.profile[0]
    machine, force, rate = parameters.plant[0], parameters.force, parameters.force_rate
    k = min(s.swing_sample, profile.samples - 2)
    part = min(max((time - s.swing_start) / profile.period - k, 0.0), 1.0)
    for i in range(3):
        changing = rate[k, i] + part * (rate[k + 1, i] - rate[k, i])
        if p.feed_forward == PNEUMATIC:
            wanted = force[k, i] + part * (force[k + 1, i] - force[k, i])
            s.feed_forward[i] = pneumatic_opening(
                machine, parameters.robot, i, state.air[0], s.reference, s.reference_velocity, wanted,
                changing, p.force_gain[i],
            )  # fmt: skip
        else:
            _, speed = actuator_motion(parameters.robot, machine, s.reference, s.reference_velocity, i)
            s.feed_forward[i] = p.rate_opening[i] * changing + p.speed_opening[i] * speed


@compiled
def _side(periods: float) -> float:
    """Return a square wave at so many periods: 1 in the first half of each, -1 in the second."""
    # A millionth of a period guards the floor against rounding of exact ticks.
    periods += 1e-6
    return 1.0 if periods - floor(periods) < 0.5 else -1.0


@compiled
def _charging(s: Any, time: float) -> bool:
    """Tell whether the chambers are being charged before the first move."""
    return bool((s.moving or s.phase == _SEARCH) and time < s.move_start)


@compiled
def estimate_tick(state: ControlState, parameters: ControlParameters, readings: Any, time: float) -> None:
    """Judge the READINGS at `time` (s) and estimate angles, velocities and the club head from them."""
    s, e = state.control[0], state.estimator[0]
    if not s.started:
        s.vent_start = time
    s.measured_step = time - s.time if s.started else 0.0
    s.started, s.time = True, time
    s.tick += 1
    decode_encoders(state.encoder, parameters.encoder, readings, time)
    for i in range(3):
        s.zero_shift[i] = 0.0
        if state.encoder[0].zero_set[i] != 0 and state.encoder[0].fresh[i] != 0:
            # The angle counts from another zero; the joint went on as before.
            begun = state.encoder[0].angle[i] - e.velocity[i] * s.measured_step
            s.zero_shift[i] = begun - e.angle[i]
            e.angle[i] = begun
    estimate(
        state.estimator, parameters.estimator, state.encoder[0].angle, state.encoder[0].age,
        state.encoder[0].fresh, s.measured_step, s.phase == _IMPACT,
    )  # fmt: skip
    s.head[0], s.head[1], s.head[2], s.head[3], s.head[4], s.head[5] = head_motion(
        parameters.robot[0], e.angle[0], e.angle[1], e.angle[2], e.velocity[0], e.velocity[1], e.velocity[2]
    )
    if parameters.model[0].check:
        observe(
            state.model[0], parameters.robot, parameters.plant, state.estimator, readings, s.applied,
            s.reference, s.measured_step,
        )  # fmt: skip
    if parameters.control[0].feed_forward == PNEUMATIC:
        observe_air(
            state.air[0], parameters.robot, parameters.plant, state.estimator, readings, s.applied,
            s.measured_step, s.phase != _IMPACT,
        )  # fmt: skip
    s.lost = readings_cause(parameters.envelope, state.estimator)
    for i in range(3):
        # An absolute count that is none any more, as after a loss of the encoder's power.
        if s.lost == 0 and s.homed and readings[0].encoder_valid[i] != 0:
            if readings[0].encoder_indexed[i] == 0:
                s.lost = _ENCODER + i
    s.seen = s.seen or s.lost == 0
    _note_impact(parameters.control[0], s)


@compiled
def decide_tick(state: ControlState, parameters: ControlParameters, readings: Any, time: float) -> None:
    """Answer the request, move swing or move on, ask the envelope, and set the desired openings."""
    s, p = state.control[0], parameters.control[0]
    interlock = interlock_cause(readings)
    note_local_reset(s, readings[0].local_reset, time)
    request = take_request(state, parameters, readings, time)
    asked = _OPERATOR if request == _STOP else _NETWORK if request == _EMERGENCY_STOP else 0
    if request != 0 and asked == 0:
        _carry_out(state, parameters, request, time)
    if s.phase != _STANDING and s.reaction <= _COMPLETE:
        _follow(state, parameters, time, s.measured_step)
    if s.phase == _STANDING:
        _watch_standing(state, parameters, readings, interlock, asked, time)
    else:
        _watch_motion(state, parameters, readings, interlock, asked, time)
        _watch_permission(s, p, time)
    if s.reaction == _BRAKE:
        _brake(state, parameters, s.lost == 0, time)
    elif s.reaction == _PASSIVE:
        _go_limp(state, parameters, s.lost == 0, time)
    elif s.reaction == _BLIND:
        _brake_blind(s, parameters, time)


@compiled
def _column(cause: int) -> int:
    """Return the column of the stopping table for a broken limit of motion or of the model."""
    if cause >= _SENSOR:
        return DOUBTED
    if _JUMP <= cause < _FLOW:
        return LOST
    if cause >= _AIR or _FOLLOWING <= cause < _FOLLOWING + 3:
        joint = (cause - (_AIR if cause >= _AIR else _FOLLOWING)) % 3  # three causes a comparison
        return WRIST_DISOBEYED if joint == 2 else DISOBEYED
    return TRUSTED


@compiled
def _watch_motion(
    state: Any, parameters: Any, readings: Any, interlock: int, asked: int, time: float
) -> None:
    """Stop as the table says what must not go on while the robot moves or holds; the first cause counts."""
    s = state.control[0]
    emergency = interlock == _E_STOP_CAUSE or asked == _NETWORK
    s.emergency = s.emergency or emergency
    if s.tick > 1 and not s.measured_step > 0.0 and s.reaction < _PASSIVE:
        # A clock that stands still, runs backwards or is none would never end a reaction that takes time.
        _react(state, parameters, _TICK_GAP, TRUSTED, time)
        s.reaction = _PASSIVE
    elif s.lost != 0:
        _react(state, parameters, s.lost, LOST, time)
    elif interlock != 0:
        _react(state, parameters, interlock, EMERGENCY if emergency else TRUSTED, time)
    elif asked != 0:
        _react(state, parameters, asked, EMERGENCY if emergency else TRUSTED, time)
    elif not s.device_operational:
        # Nothing that is commanded arrives; at least no air is left to be let in later.
        _react(state, parameters, _DEVICE, DISOBEYED, time)
    elif not s.supervisor_alive:
        _react(state, parameters, _SUPERVISOR, TRUSTED, time)
    elif s.phase == _SEARCH and s.reaction <= _COMPLETE:
        broken = search_cause(
            s, parameters.control[0], parameters.envelope[0].following[_SEARCH],
            parameters.envelope[0].greatest_gap, state.estimator[0].angle, state.estimator[0].velocity, time,
        )  # fmt: skip
        stuck = _FOLLOWING <= broken < _FOLLOWING + 3
        doubted = model_cause(
            parameters.model, state.model[0], state.estimator, s.reference_velocity, _SEARCH
        )
        if doubted != 0 and not _charging(s, time):
            _react(state, parameters, doubted, _column(doubted), time)
        elif broken != 0:
            _react(
                state, parameters, _HOMING_FAILED if stuck else broken, DISOBEYED if stuck else TRUSTED, time
            )
    elif s.reaction <= _COMPLETE:
        broken = motion_cause(
            parameters.envelope, parameters.robot, state.estimator, readings, s.reference, s.phase,
            s.measured_step, _charging(s, time),
        )  # fmt: skip
        if broken == 0 and not _charging(s, time):
            broken = model_cause(
                parameters.model, state.model[0], state.estimator, s.reference_velocity, s.phase
            )
        longest = s.move_time + parameters.control[0].move_timeout
        if broken == 0 and s.moving and time - s.move_start > longest:
            broken = _ADDRESS_TIMEOUT
        if broken != 0:
            _react(state, parameters, broken, _column(broken), time)


@compiled
def limit_tick(
    state: ControlState, parameters: ControlParameters, readings: Any, command: Any, cycle: Any
) -> None:
    """Bound the desired openings, and write COMMAND and the tick's CYCLE record."""
    s, p, c = state.control[0], parameters.control[0], command[0]
    if s.phase != _STANDING and s.reaction <= _COMPLETE and s.time >= s.air_from:
        s.air, s.vented = True, False
    powered = s.air and s.phase != _STANDING and s.reaction != _PASSIVE and not p.read_only
    for i in range(3):
        if not powered:
            s.desired[i] = 0.0
            s.applied[i] = 0.0
        else:
            if s.phase == _SEARCH:
                s.desired[i] = bounded(p, s.desired[i])
            s.applied[i] = limit(parameters.envelope, s.desired[i], s.applied[i], s.measured_step)
        c.valve[i] = s.applied[i]
    c.supply_enable = c.exhaust_closed = powered
    state.model[0].exhaust_closed = state.air[0].exhaust_closed = powered
    c.beacon = s.phase != _STANDING and s.reaction != _PASSIVE and not p.read_only
    c.guard_lock = s.state != _IN_ACCESS or s.securing
    s.tee = s.tee and powered  # after a stop no ball rises by itself
    c.tee = s.tee
    _record(state, readings, command, cycle)


@compiled
def step(
    state: ControlState, parameters: ControlParameters, readings: Any, time: float, command: Any, cycle: Any
) -> None:
    """Decide one tick at `time` (s): READINGS in, COMMAND and CYCLE records out, `state` moved on in place.

    Any reading is allowed, also one that is not a number; so is a clock that stands still or runs backwards.
    """
    estimate_tick(state, parameters, readings, time)
    decide_tick(state, parameters, readings, time)
    limit_tick(state, parameters, readings, command, cycle)


@compiled
def _record(state: ControlState, readings: Any, command: Any, cycle: Any) -> None:
    """Write the tick's CYCLE record; what only the plant knows is left to the plant's side."""
    s, e, d, r, c, out = state.control[0], state.estimator[0], state.pid[0], readings[0], command[0], cycle[0]
    out.tick, out.time, out.measured_step = s.tick, s.time, s.measured_step
    out.state, out.request, out.request_number = s.state, s.asked, s.answered_number
    out.answer, out.refusal = s.answer, s.refusal
    out.lease_held, out.support_ready, out.supervisor_alive, out.device_operational = (
        s.lease_held, s.support_ready, s.supervisor_alive, s.device_operational,
    )  # fmt: skip
    out.homed, out.vented = s.homed, s.vented
    out.phase, out.reaction, out.trip = s.phase, s.reaction, s.cause
    for i in range(3):
        out.encoder_count[i] = r.encoder_count[i]
        out.encoder_valid[i] = r.encoder_valid[i]
        out.encoder_age[i] = r.encoder_age[i]
        out.encoder_time[i] = r.encoder_time[i]
        out.encoder_indexed[i] = r.encoder_indexed[i]
        out.angle[i], out.velocity[i] = e.angle[i], e.velocity[i]
        out.angle_variance[i] = e.covariance[i, 0]
        out.reference_angle[i], out.reference_velocity[i] = s.reference[i], s.reference_velocity[i]
        out.proportional[i], out.integral[i] = d.proportional[i], d.integral[i]
        out.derivative[i] = d.derivative[i]
        out.feedforward[i] = s.feed_forward[i]
        out.desired_valve[i], out.applied_valve[i] = s.desired[i], c.valve[i]
    out.supply_enable, out.exhaust_closed, out.guard_lock = c.supply_enable, c.exhaust_closed, c.guard_lock
    out.beacon, out.tee = c.beacon, c.tee
    out.emergency_stop_clear, out.guard_closed, out.guard_locked = (
        r.emergency_stop_clear, r.guard_closed, r.guard_locked,
    )  # fmt: skip
    out.ball_present, out.local_reset = r.ball_present, r.local_reset
    out.supply_pressure = r.supply_pressure
    for i in range(6):
        out.chamber_pressure[i] = r.chamber_pressure[i]
    out.head_position[0], out.head_position[1], out.head_orientation = s.head[0], s.head[1], s.head[2]
