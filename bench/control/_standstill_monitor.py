"""Monitoring of the standing robot: vents, homing by pose, interlocks and latched states."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, State
from bench.control.estimate.residual_monitor import model_cause
from bench.control.monitor.position_monitor import lock_is_late, resting_jump, spool_cause
from bench.control.monitor.pressure_monitor import (
    air_cause,
    chambers_show_pressure,
    emptiness_is_proven,
    manifold_shows_pressure,
    nothing_is_held_up,
)
from bench.control.monitor.venting_monitor import exhaust_cause
from bench.control.moves.first_motion import forget_answers
from bench.control.moves.homing import begin_search
from bench.control.requests import is_released, manifold_is_full
from bench.control.states import change_state, disarm, is_at_rest, latch, resting_state
from drivers.base.compiled import compiled

_SECURING_TIME = 2.0
"""Timeout of a guard's lock (s)."""


@compiled
def _crept(p: Any, s: Any, e: Any) -> bool:
    """Return whether a joint is elsewhere than where it came to rest; it rests here from now on then.

    An arm that dry friction can just not hold creeps, slower than any velocity shows, and falls in the end.
    """
    crept = begun = False
    for i in range(3):
        begun = begun or not np.isfinite(s.venting.rest_angle[i])
        crept = crept or abs(e.angle[i] - s.venting.rest_angle[i]) > p.vented_creep
    if crept or begun:
        for i in range(3):
            s.venting.rest_angle[i] = e.angle[i]
    return crept


@compiled
def _monitor_venting(p: Any, s: Any, e: Any, readings: Any, time: float) -> int:
    """Check whether chambers and manifold are empty; return the cause if they should be and are not.

    A full manifold counts as not vented: one leaking or moving spool could swing the robot. A raised arm
    hangs on residual air and then sinks: it must rest with empty chambers for `rest_time_vented`, without
    trusted encoders for `rest_time_without_encoders`. Access also requires empty chambers for `access_delay`:
    a stuck encoder shows rest, and an arm held by friction may drop late. This applies from power-up, as the
    bench may have restarted right after a stop. The delay counts from a pressure that holds nothing up, and
    is at least the time to reach it: behind a throttled exhaust the last air leaves as slowly as the first.
    """
    blind = s.encoder_fault != 0 or s.encoders_suspect
    empty = not chambers_show_pressure(s.sensors, p)
    shut = not manifold_shows_pressure(s.sensors, p)
    calm = is_at_rest(s, p)
    # From an untrusted encoder only slow motion counts.
    crept = _crept(p, s, e) and s.encoder_fault == 0 and (calm or not blind)
    if not (empty and shut and (blind or (calm and not crept))):
        s.still_since = time
    wait = p.rest_time_without_encoders if blind else p.rest_time_vented
    rests = time - s.still_since >= wait or s.state == State.ACCESS
    starting = s.state == State.STARTING and not np.isfinite(s.venting.empty_since)
    if nothing_is_held_up(s.sensors, p):
        s.venting.drained_at = time
    else:
        held = time - max(s.venting.drained_at, s.venting.start)
        s.venting.empty_since = time + max(held - p.access_delay, 0.0)
    if not (empty and shut) or starting or (crept and s.state != State.ACCESS):
        s.venting.empty_since = max(s.venting.empty_since, time)
    sunk = time - s.venting.empty_since >= p.access_delay or s.state == State.ACCESS
    late = time - s.venting.start >= p.vent_timeout
    s.venting.emptied = empty and shut and rests and emptiness_is_proven(s, p, readings, time)
    s.vented = s.venting.emptied and sunk
    if s.venting.emptied and s.cause == 0:
        s.encoders_suspect = False  # not by the reset: chambers may still be full then
    slow = exhaust_cause(s.exhausts)
    s.venting.trapped = s.venting.trapped or slow != 0 or (late and not empty)
    if slow != 0:
        return int(slow)
    if not late or (empty and shut):
        return Cause.NONE.value
    return Cause.MANIFOLD.value if empty else Cause.NOT_VENTED.value


@compiled
def _report_trapped_pressure(s: Any, trapped: int) -> None:
    """Report trapped pressure also in ESTOP and FAULT: it endangers the person who clears the first cause.

    A sensor or vent that fails then is the latest cause; from then on it is no evidence for access.
    """
    slow = Cause.SHOULDER_A_EXHAUST <= s.cause <= Cause.WRIST_B_EXHAUST
    named = slow or s.cause in (Cause.NOT_VENTED, Cause.MANIFOLD)
    if trapped != 0 and not named:
        s.cause = s.latest_cause = trapped
    elif trapped == 0 and air_cause(s) != 0:
        s.latest_cause = air_cause(s)
    elif trapped == 0 and s.lock.wrong and s.cause != Cause.GUARD_LOCK:
        s.latest_cause = Cause.GUARD_LOCK


@compiled
def _monitor_homing(state: Any, parameters: Any, readings: Any, time: float) -> None:
    """Compare absolute encoders with the vented robot's pose; nothing moves before they agree."""
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    good = True
    for i in range(3):
        good = good and abs(e.angle[i] - p.home_pose[i]) <= p.home_tolerance[i]
        good = good and readings[0].encoder_indexed[i] != 0
    if not good:
        s.homing.agreed_since = time
    if time - s.homing.agreed_since >= p.home_time and p.home_stops:
        begin_search(state, p, time)
    elif time - s.homing.agreed_since >= p.home_time:
        s.homed = True
        change_state(s, parameters, State.READY, time)
    elif time - s.state_since >= 2.0 * p.home_time:
        latch(s, parameters, Cause.HOMING_FAILED, time)


@compiled
def _cause_in_access(p: Any, s: Any, readings: Any) -> int:
    """Return why the released guard's proof is gone."""
    failing: int = air_cause(s)
    if failing != 0:
        return failing
    return Cause.MANIFOLD.value if manifold_is_full(p, readings) else Cause.NOT_VENTED.value


@compiled
def _end_securing(s: Any, interlock: int, time: float) -> None:
    """End the locking of a guard whose ACCESS a cause has ended; released again if it is not seen locked."""
    if interlock == 0:
        s.securing = s.guard_was_opened = False
    elif time - s.state_since >= _SECURING_TIME:
        s.securing = False


@compiled
def _forget_lost_zero(s: Any, readings: Any) -> None:
    """Forget the homing when an encoder fails at rest, or a valid one has lost its index."""
    if s.encoder_fault != 0 and s.encoders_seen_valid:
        s.homed = False  # whatever turned meanwhile, no reading shows it
    for i in range(3):
        if readings[0].encoder_valid[i] != 0 and readings[0].encoder_indexed[i] == 0:
            s.homed = False


@compiled
def _monitor_access(s: Any, parameters: Any, readings: Any, interlock: int, time: float) -> None:
    """Latch pressure that comes back while the guard is released; end ACCESS once it is seen locked."""
    if not s.vented:
        latch(s, parameters, _cause_in_access(parameters.control[0], s, readings), time)
    elif lock_is_late(s, time):
        latch(s, parameters, Cause.GUARD_LOCK, time)
    elif s.securing and interlock == 0:
        s.securing = s.guard_was_opened = False
        change_state(s, parameters, resting_state(s), time)
    elif s.securing and time - s.state_since >= _SECURING_TIME:
        latch(s, parameters, Cause.GUARD, time)


@compiled
def monitor_standstill(
    state: Any, parameters: Any, readings: Any, interlock: int, asked: int, time: float
) -> None:
    """Latch the causes found at standstill, and leave the states of standstill."""
    s, p = state.control[0], parameters.control[0]
    trapped = _monitor_venting(p, s, state.estimator[0], readings, time)
    jumped = model_cause(parameters.model, state.model[0], state.estimator, s.reference_velocity, s.phase)
    if jumped == 0:
        jumped = int(s.homing.index_wrong) if s.homing.index_wrong != 0 else resting_jump(state.estimator[0])
    _forget_lost_zero(s, readings)
    if s.state == State.STARTING:
        if s.is_warmed_up:
            latch(s, parameters, int(s.first_cause), time)
        return
    if is_released(s) or not readings[0].guard_closed or Cause.GUARD in (s.cause, s.latest_cause):
        forget_answers(s)  # a person may have been inside, also through a guard with a bridged switch
    if is_released(s) and not readings[0].guard_closed:
        s.guard_was_opened = True
    elif s.securing and s.state != State.ACCESS:
        _end_securing(s, interlock, time)
    if interlock == Cause.EMERGENCY_STOP or asked == Cause.NETWORK_STOP:
        if s.state != State.ESTOP:
            by_circuit = interlock == Cause.EMERGENCY_STOP
            latch(s, parameters, Cause.EMERGENCY_STOP if by_circuit else Cause.NETWORK_STOP, time)
        else:
            s.reset_pressed = -np.inf
            _report_trapped_pressure(s, trapped)
        return
    if s.state in (State.ESTOP, State.FAULT):
        _report_trapped_pressure(s, trapped)
        return
    if not s.supervisor_alive or not s.device_operational:
        latch(s, parameters, Cause.DEVICE_PASSIVE if s.supervisor_alive else Cause.SUPERVISOR, time)
    elif s.state == State.ACCESS:
        _monitor_access(s, parameters, readings, interlock, time)
    elif s.tick > 1 and not s.measured_step > 0.0:
        latch(s, parameters, Cause.TICK_GAP, time)
    elif interlock != 0:
        latch(s, parameters, interlock, time)
    elif asked != 0:  # also at rest: a client that would arm next sees that a person wants no motion
        latch(s, parameters, asked, time)
    elif s.encoder_fault != 0 and s.encoders_seen_valid and s.state != State.SAFE:
        latch(s, parameters, int(s.encoder_fault), time)
    elif s.state == State.READY and jumped != 0:
        s.homed, s.encoders_suspect = False, True  # whatever turned there, it was not the joint
        latch(s, parameters, jumped, time)
    elif trapped != 0:
        latch(s, parameters, trapped, time)
    elif air_cause(s) != 0:
        latch(s, parameters, air_cause(s), time)
    elif spool_cause(s) != 0:
        latch(s, parameters, spool_cause(s), time)
    elif s.state == State.READY and not s.homed:
        change_state(s, parameters, State.SAFE, time)
    elif s.state == State.HOMING:
        if not s.lease_held:
            disarm(s, parameters, time)
        else:
            _monitor_homing(state, parameters, readings, time)
