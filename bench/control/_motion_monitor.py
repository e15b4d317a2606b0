"""Monitoring of the moving or holding robot, and the reactions that stop it."""

from __future__ import annotations

from typing import Any

from bench.base.lifecycle import (
    ACTUATOR_FAULT,
    CHAMBER_SUSPECT,
    EMERGENCY,
    READINGS_LOST,
    READINGS_VALID,
    WRIST_FAULT,
    Cause,
    Phase,
    Reaction,
    State,
)
from bench.control.envelope import motion_cause
from bench.control.estimate.residual_monitor import BRAKING, model_cause, row_of
from bench.control.monitor.position_monitor import spool_cause
from bench.control.monitor.pressure_monitor import air_cause
from bench.control.moves.address_pressure import address_air_cause
from bench.control.moves.first_motion import first_motion_cause
from bench.control.moves.ground_clearance import monitor_low_head
from bench.control.moves.homing import search_cause
from bench.control.moves.references import charging
from bench.control.states import disarm, react
from drivers.base.compiled import compiled

_LOST_SUPPLY = 0.5
"""Fraction of the least supply pressure of a swing below which a manifold is not fed."""
_TIMER = 0.8
"""Fraction of the shut-off valve's delay for which it is sure to be open: its timer is pneumatic."""


@compiled
def table_column(cause: int) -> int:
    """Return the column of the stopping table for a broken limit of motion or of the model."""
    if Cause.SHOULDER_SENSOR <= cause <= Cause.WRIST_SENSOR:
        return CHAMBER_SUSPECT
    if Cause.SHOULDER_JUMP <= cause <= Cause.WRIST_EFFORT:
        return READINGS_LOST
    # One cause a joint.
    if cause in (Cause.SHOULDER_FOLLOWING, Cause.ARM_FOLLOWING):
        return ACTUATOR_FAULT
    if Cause.SHOULDER_AIR <= cause <= Cause.WRIST_FLOW:
        return WRIST_FAULT if (cause - Cause.SHOULDER_AIR) % 3 == 2 else ACTUATOR_FAULT
    if cause in (Cause.SHOULDER_SPOOL, Cause.ARM_SPOOL):
        return ACTUATOR_FAULT
    return WRIST_FAULT if cause in (Cause.WRIST_FOLLOWING, Cause.WRIST_SPOOL) else READINGS_VALID


@compiled
def monitor_motion(
    state: Any, parameters: Any, readings: Any, interlock: int, asked: int, time: float
) -> None:
    """Stop the moving or holding robot for the first cause found, as the stopping table says."""
    s = state.control[0]
    emergency = interlock == Cause.EMERGENCY_STOP or asked == Cause.NETWORK_STOP
    s.emergency = s.emergency or emergency
    if s.tick > 1 and not s.measured_step > 0.0 and s.reaction < Reaction.PASSIVE:
        # With a clock that stands still, runs backwards or is NaN a timed reaction would never end.
        react(state, parameters, Cause.TICK_GAP, READINGS_VALID, time)
        s.reaction = Reaction.PASSIVE
    elif s.encoder_fault != 0:
        react(state, parameters, int(s.encoder_fault), READINGS_LOST, time)
        if not s.device_operational:
            react(state, parameters, Cause.DEVICE_PASSIVE, ACTUATOR_FAULT, time)
    else:
        if interlock != 0:
            react(state, parameters, interlock, EMERGENCY if emergency else READINGS_VALID, time)
        elif asked != 0:
            react(state, parameters, asked, EMERGENCY if emergency else READINGS_VALID, time)
        elif not s.device_operational:
            # No command arrives; at least no air remains that could enter later.
            react(state, parameters, Cause.DEVICE_PASSIVE, ACTUATOR_FAULT, time)
        elif not s.supervisor_alive:
            react(state, parameters, Cause.SUPERVISOR, READINGS_VALID, time)
        elif air_cause(s) != 0:
            react(state, parameters, air_cause(s), READINGS_VALID, time)
        elif s.homing.index_wrong != 0:
            # From here on the count is right.
            react(state, parameters, int(s.homing.index_wrong), READINGS_VALID, time)
        misplaced = spool_cause(s)
        if misplaced != 0:
            react(state, parameters, misplaced, table_column(misplaced), time)
        # A stop needs its valves and encoders as much as a swing does, so it is also monitored.
        if s.reaction > Reaction.COMPLETE:
            _monitor_braking(state, parameters, readings, time)
        elif s.phase == Phase.HOMING:
            _monitor_search(state, parameters, time)
        else:
            _monitor_swing(state, parameters, readings, time)


@compiled
def _monitor_braking(state: Any, parameters: Any, readings: Any, time: float) -> None:
    """Escalate a BRAKE that does not fit the model, and name one that has lost its supply.

    The envelope has nothing to add: without a reference no following error exists, and for its other limits
    the stopping table has nothing more severe than BRAKE. The pressure of an emptied manifold is below any
    that braking leaves in a supplied one. After the safety relay opens, the manifold is supplied until the
    shut-off valve shuts.
    """
    s, e = state.control[0], state.estimator[0]
    if s.reaction == Reaction.BRAKE and not charging(s, time):
        lost = readings[0].supply_pressure < _LOST_SUPPLY * parameters.envelope[0].min_supply_pressure
        fed = s.venting.timer <= _TIMER * parameters.control[0].shut_off_delay
        if lost and s.sensors.doubt[0] <= 0.0 and fed:
            react(state, parameters, Cause.SUPPLY_PRESSURE, READINGS_VALID, time)
        # The estimated velocity as reference: a brake has none.
        row, doubted = BRAKING + s.phase, int(s.cause - Cause.SHOULDER_SENSOR)
        broken = model_cause(parameters.model, state.model[0], state.estimator, e.velocity, row, doubted)
        if broken != 0:
            if table_column(broken) == READINGS_LOST:
                _note_doubted(s, parameters.model[0], e, broken)
            react(state, parameters, broken, table_column(broken), time)


@compiled
def _note_doubted(s: Any, limits: Any, e: Any, broken: int) -> None:
    """Note the joints whose encoders the cause `broken` makes suspect.

    An encoder that jumps, or gives no sample, distorts the torques of all joints: then only it is suspect.
    """
    found, row = False, limits.first_row + BRAKING + s.phase
    for i in range(3):
        if e.without_sample[i] > 0.0 or abs(e.innovation[i]) > limits.jump[row, i]:
            s.open_loop_joints[i] = 1
            found = True
    if not found:
        s.open_loop_joints[(broken - Cause.SHOULDER_JUMP) % 3] = 1


@compiled
def _monitor_search(state: Any, parameters: Any, time: float) -> None:
    """Stop the search for an index that leaves its limits, or does not fit the model."""
    s, e, limits = state.control[0], state.estimator[0], parameters.envelope[0]
    following = limits.max_following_error[Phase.HOMING.value]
    broken = search_cause(
        s, parameters.control[0], following, limits.max_tick_interval, e.angle, e.velocity, time
    )
    if broken == 0:
        broken = first_motion_cause(s, parameters.control[0], e.velocity)
    stuck = Cause.SHOULDER_FOLLOWING <= broken < Cause.SHOULDER_FOLLOWING + 3
    doubted = model_cause(parameters.model, state.model[0], state.estimator, s.reference_velocity, s.phase)
    if doubted != 0 and not charging(s, time):
        react(state, parameters, doubted, table_column(doubted), time)
    elif Cause.SHOULDER_ZERO <= broken <= Cause.WRIST_ZERO:
        react(state, parameters, broken, ACTUATOR_FAULT, time)
    elif stuck:
        react(state, parameters, Cause.HOMING_FAILED, ACTUATOR_FAULT, time)
    elif broken != 0:
        react(state, parameters, broken, READINGS_VALID, time)


@compiled
def _monitor_swing(state: Any, parameters: Any, readings: Any, time: float) -> None:
    """Stop a swing, a move or a hold that leaves the envelope, or does not fit the model."""
    s = state.control[0]
    # With planned air the joints stay where they are while it comes in.
    low = monitor_low_head(s, parameters.envelope, time) if parameters.profile[0].air_planned else 0.0
    broken = motion_cause(
        parameters.envelope,
        parameters.robot,
        state.estimator,
        readings,
        s.reference,
        s.phase,
        s.measured_step,
        charging(s, time),
        low,
    )
    if broken == Cause.SUPPLY_PRESSURE and s.sensors.doubt[0] > 0.0:
        broken = Cause.SUPPLY_SENSOR.value
    if broken == 0 and not charging(s, time):
        row = row_of(s)
        broken = model_cause(parameters.model, state.model[0], state.estimator, s.reference_velocity, row)
    if broken == 0 and (s.moving or s.phase == Phase.HOLD):
        broken = first_motion_cause(s, parameters.control[0], state.estimator[0].velocity)
    longest = s.move.duration + parameters.control[0].move_timeout
    if broken == 0 and s.moving and time - s.move.start > longest:
        broken = Cause.ADDRESS_TIMEOUT.value
    if broken == 0:
        broken = address_air_cause(state, parameters, time)
    if broken != 0:
        react(state, parameters, broken, table_column(broken), time)


@compiled
def monitor_permission(s: Any, parameters: Any, time: float) -> None:
    """Disarm if the lease or the recorder is lost, or the address was held for too long."""
    if s.state == State.ARMED and s.reaction == Reaction.NONE:
        waited = s.phase == Phase.HOLD and time - s.state_since > parameters.control[0].armed_timeout
        if waited or not (s.lease_held and s.support_ready):
            disarm(s, parameters, time)
    elif s.state == State.HOMING and s.reaction == Reaction.NONE and not s.lease_held:
        disarm(s, parameters, time)
    elif s.state in (State.SWINGING, State.RECOVERING) and not (s.lease_held and s.support_ready):
        s.disarming = True  # also if both come back: nothing is rearmed automatically
