"""The deciding part of the cycle: one compiled function from readings to command.

`step` estimates, decides and limits. It reads no clock, allocates nothing and raises nothing; all it
remembers is in the records of `ControlState`. The same functions run in the real-time loop, which takes the
time of each, in lock-step simulation and in sweeps.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase, Reaction, Request
from bench.control._motion_monitor import monitor_motion, monitor_permission
from bench.control._standstill_monitor import monitor_standstill
from bench.control.envelope import interlock_cause, limit, readings_cause, relay_closed
from bench.control.estimate.air import conductance_of_vents, observe_air
from bench.control.estimate.encoder import decode_encoders
from bench.control.estimate.estimator import estimate
from bench.control.estimate.residual_monitor import observe
from bench.control.law.feed_forward import PNEUMATIC
from bench.control.law.gain_table import supply_factor
from bench.control.monitor.position_monitor import index_cause, monitor_guard_lock, monitor_spools
from bench.control.monitor.pressure_monitor import VENTS, air_fault, monitor_pressures
from bench.control.monitor.venting_monitor import monitor_exhausts, monitor_manifold
from bench.control.moves.braking import brake, brake_blind, wait_passive
from bench.control.moves.ground_clearance import escape
from bench.control.moves.homing import bounded
from bench.control.moves.motion import follow
from bench.control.requests import execute_request, handle_request, is_released, monitor_local_reset
from bench.control.states import filter_velocity, is_at_rest
from bench.control.step_records import ControlParameters, ControlState
from drivers.base.compiled import compiled
from sim.kinematics import head_motion

MAX_PREDICTION = 60.0
"""Max prediction of the filters (s); a longer jump leaves no digits to their covariances."""


@compiled
def estimate_tick(state: ControlState, parameters: ControlParameters, readings: Any, time: float) -> None:
    """Judge the READINGS at `time` (s); estimate angles, velocities and the club head from them."""
    s, e = state.control[0], state.estimator[0]
    s.tick += 1
    if np.isfinite(time):
        if not s.started:
            s.venting.start = time
        s.measured_step = time - s.time if s.started else 0.0
        s.started, s.time = True, time
    else:
        # A fault in this tick; the next step counts from the last finite time.
        s.measured_step, time = 0.0, s.time
    elapsed = min(max(s.measured_step, 0.0), MAX_PREDICTION)
    _restart_filters(s, e)
    decode_encoders(state.encoder, parameters.encoder, readings, time)
    _move_to_new_zeros(s, e, state.encoder[0], elapsed)
    estimate(
        state.estimator,
        parameters.estimator,
        state.encoder[0].angle,
        state.encoder[0].age,
        state.encoder[0].fresh,
        elapsed,
        s.phase == Phase.IMPACT,
    )
    s.head[0], s.head[1], s.head[2], s.head[3], s.head[4], s.head[5] = head_motion(
        parameters.robot[0], e.angle[0], e.angle[1], e.angle[2], e.velocity[0], e.velocity[1], e.velocity[2]
    )
    _observe(state, parameters, readings, elapsed)
    _monitor_inputs(state, parameters, readings, elapsed, time)
    s.encoder_fault = readings_cause(parameters.envelope, state.estimator)
    _note_lost_index(s, readings)
    s.encoders_seen_valid = s.encoders_seen_valid or s.encoder_fault == 0
    filter_velocity(s, parameters.control[0], e, elapsed)
    _note_impact(parameters.control[0], s)


@compiled
def _observe(state: Any, parameters: Any, readings: Any, elapsed: float) -> None:
    """Move the observers of valves and air on by `elapsed` s."""
    s = state.control[0]
    s.venting.timer = 0.0 if s.exhaust_closed and relay_closed(readings) else s.venting.timer + elapsed
    vent = conductance_of_vents(parameters.plant[0], readings[0], s.venting.timer)
    if parameters.model[0].check:
        observe(
            state.model[0],
            parameters.robot,
            parameters.plant,
            parameters.envelope,
            state.estimator,
            state.encoder[0].indexed,
            readings,
            s.applied,
            s.reference,
            s.head,
            vent,
            s.reaction == Reaction.BRAKE,
            elapsed,
        )
    if parameters.control[0].feed_forward == PNEUMATIC or parameters.profile[0].air_planned:
        observe_air(
            state.air[0],
            parameters.robot,
            parameters.plant,
            state.estimator,
            readings,
            s.applied,
            s.exhaust_closed,
            vent,
            elapsed,
            s.phase != Phase.IMPACT,
        )


@compiled
def _monitor_inputs(state: Any, parameters: Any, readings: Any, elapsed: float, time: float) -> None:
    """Judge sensors, vents, manifold, spools, guard's lock and index `elapsed` s after the last tick."""
    s, p = state.control[0], parameters.control[0]
    monitor_pressures(s, p, readings, s.exhaust_closed, elapsed, time)
    monitor_manifold(s, p, parameters.plant[0], readings, s.exhaust_closed, elapsed)
    monitor_exhausts(s, p, parameters.robot, parameters.plant[0], state.estimator[0], readings, elapsed)
    monitor_spools(s, parameters.envelope[0], parameters.plant[0], readings, elapsed)
    monitor_guard_lock(s, readings, is_released(s), time)
    s.homing.index_wrong = index_cause(s, p, state.encoder[0], parameters.encoder[0], state.estimator[0])


@compiled
def _note_lost_index(s: Any, readings: Any) -> None:
    """Distrust a count that is no longer absolute, as after a loss of the encoder's power."""
    for i in range(3):
        if s.encoder_fault == 0 and s.homed and readings[0].encoder_valid[i] != 0:
            if readings[0].encoder_indexed[i] == 0:
                s.encoder_fault = Cause.SHOULDER_ENCODER + i


@compiled
def decide_tick(state: ControlState, parameters: ControlParameters, readings: Any, time: float) -> None:
    """Answer the request, advance swing or move, monitor, change state and set desired valve commands."""
    s = state.control[0]
    if not np.isfinite(time):
        time = s.time
    interlock = interlock_cause(readings)
    monitor_local_reset(s, readings, time)
    if not is_at_rest(s, parameters.control[0]):
        s.moved_at = time
    request = handle_request(state, parameters, readings, time)
    asked = Cause.NONE
    if request == Request.STOP:
        asked = Cause.OPERATOR_STOP
    elif request == Request.EMERGENCY_STOP:
        asked = Cause.NETWORK_STOP
    if request != 0 and asked == 0:
        execute_request(state, parameters, request, time)
    if s.phase == Phase.HOLD:
        state.pid[0].supply_factor = supply_factor(parameters.pid[0].supply, readings[0].supply_pressure)
    if s.phase != Phase.STANDING and s.reaction <= Reaction.COMPLETE:
        follow(state, parameters, time, s.measured_step)
    if s.phase == Phase.STANDING:
        monitor_standstill(state, parameters, readings, interlock, asked, time)
    else:
        monitor_motion(state, parameters, readings, interlock, asked, time)
        monitor_permission(s, parameters, time)
    if s.reaction == Reaction.BRAKE:
        brake(state, parameters, readings, s.encoder_fault == 0, time)
    elif s.reaction == Reaction.PASSIVE:
        wait_passive(state, parameters, s.encoder_fault == 0, time)
    elif s.reaction == Reaction.BLIND_BRAKE:
        brake_blind(state, parameters, time)
    escape(s, parameters.control[0], time)


@compiled
def limit_tick(
    state: ControlState, parameters: ControlParameters, readings: Any, command: Any, cycle: Any
) -> None:
    """Bound the desired valve commands, and write COMMAND and the tick's CYCLE record."""
    s, p, c = state.control[0], parameters.control[0], command[0]
    centre = parameters.plant[0].centre
    if s.phase != Phase.STANDING and s.reaction <= Reaction.COMPLETE and s.time >= s.air_from:
        s.air, s.vented, s.venting.emptied, s.venting.trapped = True, False, False, False
    obeyed = s.air and s.phase != Phase.STANDING and not p.read_only
    powered = obeyed and s.reaction != Reaction.PASSIVE
    for i in range(3):
        if not (powered or (obeyed and s.turf_override[i] != 0)):
            s.desired[i] = 0.0
            s.applied[i] = 0.0
        else:
            if s.phase == Phase.HOMING:
                s.desired[i] = bounded(p, s.desired[i])
            s.desired[i] += centre[i]  # until here relative to the spool's known centre
            s.applied[i] = limit(parameters.envelope, s.desired[i], s.applied[i], s.measured_step)
        c.valve[i] = s.applied[i]
    c.supply_enable = c.exhaust_closed = powered
    s.exhaust_closed = powered
    c.beacon = s.phase != Phase.STANDING and s.reaction != Reaction.PASSIVE and not p.read_only
    c.search_index = (
        p.home_by_index and s.phase == Phase.HOMING and s.reaction < Reaction.PASSIVE and not p.read_only
    )
    c.guard_lock = not is_released(s)
    s.tee = s.tee and powered  # after a stop no ball rises automatically
    c.tee = s.tee
    _record(state, readings, command, cycle)


@compiled
def step(
    state: ControlState, parameters: ControlParameters, readings: Any, time: float, command: Any, cycle: Any
) -> None:
    """Decide one tick at `time` (s): READINGS in, COMMAND and CYCLE records out, `state` updated in place.

    Any reading is allowed, NaN too; so is a clock that stands still or runs backwards.
    """
    estimate_tick(state, parameters, readings, time)
    decide_tick(state, parameters, readings, time)
    limit_tick(state, parameters, readings, command, cycle)


@compiled
def _move_to_new_zeros(s: Any, e: Any, encoder: Any, elapsed: float) -> None:
    """Shift the estimates of angles whose zero changed in this tick."""
    for i in range(3):
        s.homing.zero_shift[i] = 0.0
        if encoder.zero_set[i] != 0 and encoder.fresh[i] != 0:
            # The angle counts from another zero; the joint's motion is unchanged.
            begun = encoder.angle[i] - e.velocity[i] * elapsed
            s.homing.zero_shift[i] = begun - e.angle[i]
            e.angle[i] = begun


@compiled
def _restart_filters(s: Any, e: Any) -> None:
    """Let a filter whose estimate is not finite begin again, once that has stopped the robot."""
    for i in range(3):
        total = e.angle[i] + e.velocity[i] + e.acceleration[i]
        for k in range(6):
            total += e.covariance[i, k]
        if s.phase == Phase.STANDING and not np.isfinite(total):
            e.started[i] = 0


@compiled
def _note_impact(p: Any, s: Any) -> None:
    """Detect a struck ball by the drop of head speed in the impact window."""
    speed = sqrt(s.head[3] * s.head[3] + s.head[4] * s.head[4])
    if s.phase == Phase.IMPACT:
        s.swing.fastest_head = max(s.swing.fastest_head, speed)
        if speed < (1.0 - p.impact_speed_drop) * s.swing.fastest_head:
            s.swing.struck = True


@compiled
def _record(state: ControlState, readings: Any, command: Any, cycle: Any) -> None:
    """Write the tick's CYCLE record, but for the fields that only the plant knows."""
    s, e, d, r, c, out = state.control[0], state.estimator[0], state.pid[0], readings[0], command[0], cycle[0]
    out.tick, out.time, out.measured_step = s.tick, s.time, s.measured_step
    out.state, out.request, out.request_number = s.state, s.handled_request, s.answered_number
    out.answer, out.refusal = s.answer, s.refusal
    out.lease_held, out.support_ready, out.supervisor_alive, out.device_operational = (
        s.lease_held,
        s.support_ready,
        s.supervisor_alive,
        s.device_operational,
    )
    out.homed, out.vented = s.homed, s.vented
    out.phase, out.reaction, out.cause, out.latest_cause = s.phase, s.reaction, s.cause, s.latest_cause
    for i in range(3):
        out.encoder_count[i] = r.encoder_count[i]
        out.encoder_valid[i] = r.encoder_valid[i]
        out.encoder_age[i] = r.encoder_age[i]
        out.encoder_time[i] = r.encoder_time[i]
        out.encoder_indexed[i] = r.encoder_indexed[i]
        out.spool_position[i] = r.spool_position[i]
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
        r.emergency_stop_clear,
        r.guard_closed,
        r.guard_locked,
    )
    out.ball_present, out.local_reset = r.ball_present, r.local_reset
    out.supply_pressure = r.supply_pressure
    out.air_fault = air_fault(s)
    for k in range(VENTS):
        out.vent_open[k] = r.vent_open[k]
    out.shut_off_open = r.shut_off_open
    for i in range(6):
        out.chamber_pressure[i] = r.chamber_pressure[i]
    out.head_position[0], out.head_position[1], out.head_orientation = s.head[0], s.head[1], s.head[2]
    out.head_speed = sqrt(s.head[3] * s.head[3] + s.head[4] * s.head[4])
