"""Requests to the bench: each is accepted and executed, or refused with the reason, in its tick."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Answer, Cause, Phase, Reaction, Refusal, Request, State
from bench.control.envelope import interlock_cause
from bench.control.law.pid import reset_integral
from bench.control.monitor.position_monitor import spool_cause
from bench.control.monitor.pressure_monitor import air_cause, all_chambers_are_seen, chambers_show_pressure
from bench.control.moves.homing import begin_search
from bench.control.moves.references import begin_move, follow_profile
from bench.control.states import change_state, disarm, near_address
from drivers.base.compiled import compiled

STOP_LOCKOUT_TIME = 1.5
"""Time after a stop in which no motion begins (s): requests sent before the stop are older than it. The
command plane drops a request that has waited for longer than this less half a second, in which the loop takes
it."""


_READING = 600.0
"""Time in which a person reads the gauges after a request was refused for them (s)."""


@compiled
def note_local_reset(s: Any, pressed: bool, time: float) -> None:
    """Store the time of the last press of the local reset; a level never seen low is no press."""
    if pressed and s.reset_was_low:
        s.reset_pressed = time
        s.reset_was_low = False
    elif not pressed:
        s.reset_was_low = True


@compiled
def is_released(s: Any) -> bool:
    """Return whether the guard's lock is released: in ACCESS, and until SECURE once the guard was opened.

    A cause found in ACCESS ends that state, but does not lock in a person inside.
    """
    return bool((s.state == State.ACCESS or s.guard_was_opened) and not s.securing)


@compiled
def monitor_local_reset(s: Any, readings: Any, time: float) -> None:
    """Record a press of the local reset, and discard one that an open interlock has made void.

    Inputs that do not arrive read False: a low level counts only while the device answers and the emergency
    stop circuit is seen closed. So a stuck button gives no edge when a lost link comes back. A press before
    an interlock opened is void: the person who gave it did not see the later events.
    """
    r = readings[0]
    note_local_reset(s, r.local_reset, time)
    if not (s.device_operational and r.emergency_stop_clear):
        s.reset_was_low = False
    released = is_released(s)
    if not (r.emergency_stop_clear and r.guard_closed and (r.guard_locked or released)):
        s.reset_pressed = -np.inf


@compiled
def _is_confirmed(p: Any, s: Any, time: float) -> bool:
    """Return whether a person at the robot has pressed the local reset, where one is fitted."""
    return bool(not p.local_reset or time - s.reset_pressed <= p.local_reset_time)  # False with NaN


@compiled
def manifold_is_full(p: Any, readings: Any) -> bool:
    """Return whether the supply manifold shows pressure; one without a sensor shows none."""
    return bool(readings[0].supply_pressure > p.vented_pressure)


@compiled
def _not_vented(p: Any, s: Any, readings: Any) -> int:
    """Return the refusal that names where the pressure may be, or the sensor or valve that proves nothing."""
    if Cause.SUPPLY_SENSOR <= air_cause(s) < Cause.VENT_1:
        return Refusal.SENSOR.value
    if s.shut_off.wrong:
        return Refusal.VENT.value
    full = readings[0].supply_pressure > p.holding_pressure
    return Refusal.MANIFOLD.value if full else Refusal.NOT_VENTED.value


@compiled
def _failing(s: Any, request: int) -> int:
    """Return the refusal of `request` for a lock, spool, sensor, vent or manifold that fails, or 0."""
    cause = air_cause(s)
    if s.lock.wrong:
        return Refusal.LOCK.value
    if spool_cause(s) != 0:
        return Refusal.VENT.value
    # A sensor that fell too fast proves itself at the next venting, which takes a reset and air.
    if cause == 0 or (request == Request.RESET and cause == Cause.SUPPLY_DECAY):
        return 0
    if cause in (Cause.VENT_1, Cause.VENT_2, Cause.SHUT_OFF):
        return Refusal.VENT.value
    return Refusal.MANIFOLD.value if cause == Cause.SUPPLY_VALVE else Refusal.SENSOR.value


@compiled
def _settling(p: Any, s: Any, request: int, time: float) -> int:
    """Return the refusal of `request` while a joint moves or, before arming, a chamber holds air, or 0."""
    # A joint that reverses is also slow for an instant. A swing requires more: rest at the address.
    if request != Request.SWING and time - s.moved_at < p.rest_time:
        return Refusal.MOVING.value
    # Trapped air holds a robot up, and lets it fall while its chambers vent further in the warning.
    if request == Request.ARM and chambers_show_pressure(s.sensors, p):
        return Refusal.NOT_VENTED.value
    return 0


@compiled
def _not_at_address(s: Any, parameters: Any, estimator: Any) -> int:
    """Return the refusal of a swing while robot or air are not at the address as planned, or 0."""
    if s.phase != Phase.HOLD or s.swinging:
        return Refusal.NOT_AT_ADDRESS.value
    if parameters.profile[0].air_planned and not s.address_air.ready:
        return Refusal.AIR.value  # meanwhile a joint may move a little
    return 0 if near_address(parameters, estimator) else Refusal.NOT_AT_ADDRESS.value


@compiled
def _access_refusal(p: Any, s: Any, readings: Any, time: float) -> int:
    if interlock_cause(readings) == Cause.EMERGENCY_STOP:
        return Refusal.EMERGENCY_STOP.value
    if s.manifold.unproven:
        return Refusal.SENSOR.value
    # A robot at power-up may still sink: its rest is not verified yet.
    if not (s.vented and time - s.venting.start >= p.rest_time_vented):
        return _not_vented(p, s, readings)
    # Time and a vent's position prove no flow: without a sensor's evidence a person reads the gauge. Even
    # after a press the first request is refused: its sender learns that the supply is locked. A press long
    # after that tells of no reading.
    asked = s.refusal == Refusal.GAUGE and time - s.gauge_refused <= _READING
    read = p.local_reset and _is_confirmed(p, s, time) and asked
    unread = (s.venting.trapped or not all_chambers_are_seen(s.sensors)) and not read
    return Refusal.GAUGE.value if unread else Refusal.NONE.value


@compiled
def check_request(state: Any, parameters: Any, readings: Any, request: int, time: float) -> int:
    """Return why `request` is refused now, or Refusal.NONE; a stop is never refused."""
    s, p = state.control[0], parameters.control[0]
    if request in (Request.STOP, Request.EMERGENCY_STOP):
        return Refusal.NONE
    if p.read_only:
        return Refusal.READ_ONLY
    if request >= len(p.accepted) or p.accepted[request, s.state] == 0:
        return Refusal.STATE
    if request == Request.SECURE and s.state != State.ACCESS and not s.guard_was_opened:
        return Refusal.STATE
    if s.reaction > Reaction.COMPLETE and s.phase != Phase.STANDING:
        return Refusal.STOPPING
    if p.needs_lease[request] != 0 and not s.lease_held:
        return Refusal.NO_LEASE
    # A passive device obeys nothing; the reset sets it to work again.
    if not s.device_operational and request in (Request.ARM, Request.SWING, Request.HOME, Request.ACCESS):
        return Refusal.DEVICE
    if request == Request.ACCESS:
        return _access_refusal(p, s, readings, time)
    if request == Request.SECURE:
        if not readings[0].guard_closed:
            return Refusal.GUARD
        return Refusal.NONE if _is_confirmed(p, s, time) else Refusal.LOCAL_RESET
    if request in (Request.ARM, Request.SWING, Request.RESET, Request.HOME):
        interlock = interlock_cause(readings)
        if interlock != 0 or is_released(s):  # a contact that bounces shows a released lock as locked
            return Refusal.EMERGENCY_STOP if interlock == Cause.EMERGENCY_STOP else Refusal.GUARD
        if s.encoder_fault != 0:
            return Refusal.READINGS
        if not s.supervisor_alive:
            return Refusal.SUPERVISOR
        failing = _failing(s, request)
        if failing != 0:
            return failing
        if request != Request.RESET and time - s.stopped_at < STOP_LOCKOUT_TIME:
            return Refusal.STOPPED
        settling = _settling(p, s, request, time)
        if settling != 0:
            return settling
    if request == Request.TEE:
        # A robot that comes back from a swing passes over the ball's place, and is slow well before it rests.
        return _settling(p, s, request, time)
    if request in (Request.ARM, Request.SWING):
        if not s.support_ready:
            return Refusal.SUPPORT
    if request == Request.SWING:
        waiting = _not_at_address(s, parameters, state.estimator)
        if waiting != 0:
            return waiting
    if not s.venting.emptied:
        # The pose proves a zero only while no air holds the robot.
        if request == Request.HOME and not p.home_by_index:
            return _not_vented(p, s, readings)
        if request == Request.RESET and time - s.venting.start >= p.vent_timeout:
            return _not_vented(p, s, readings)
    if request == Request.RESET and not _is_confirmed(p, s, time):
        return Refusal.LOCAL_RESET
    return Refusal.NONE


@compiled
def handle_request(state: Any, parameters: Any, readings: Any, time: float) -> int:
    """Answer the request of this tick; return it if accepted, otherwise 0."""
    s = state.control[0]
    request = s.request
    s.request = 0
    s.handled_request = request
    if request == 0:
        return 0
    if request in (Request.STOP, Request.EMERGENCY_STOP):
        s.stopped_at = time
    # A stop comes past the numbered requests: the answer to the last one may not have been read yet.
    if request in (Request.STOP, Request.EMERGENCY_STOP) and s.answered_number == s.request_number != 0:
        return int(request)
    s.answered_number = s.request_number
    s.refusal = check_request(state, parameters, readings, request, time)
    if s.refusal == Refusal.GAUGE:
        s.gauge_refused = time
    if s.refusal != 0:
        s.answer = Answer.REFUSED
        return 0
    s.answer = Answer.ACCEPTED
    return int(request)


@compiled
def execute_request(state: Any, parameters: Any, request: int, time: float) -> None:
    """Carry out the accepted `request`."""
    s = state.control[0]
    if request == Request.RESET:
        _reset(s, parameters, time)
    elif request == Request.HOME:
        _begin_homing(state, parameters, time)
    elif request == Request.ARM:
        _arm(state, parameters, time)
    elif request == Request.SWING:
        _begin_swing(s, parameters, time)
    elif request == Request.DISARM:
        if s.state == State.RECOVERING:
            s.disarming = True  # the return is the safe way home; then nothing stays armed
        else:
            disarm(s, parameters, time)
    elif request == Request.ACCESS:
        if change_state(s, parameters, State.ACCESS, time):
            s.securing = s.venting.trapped = False
    elif request == Request.SECURE:
        s.securing, s.state_since, s.reset_pressed = True, time, -np.inf
    elif request == Request.TEE:
        s.tee = True


@compiled
def _reset(s: Any, parameters: Any, time: float) -> None:
    if change_state(s, parameters, State.READY if s.homed else State.SAFE, time):
        s.cause = s.latest_cause = 0
        s.manifold.excused = s.manifold.unproven
        for k in range(len(s.exhausts.slow)):
            s.exhausts.slow[k] = 0
        s.emergency = False
        s.reaction, s.reset_pressed, s.stopped_at = Reaction.NONE, -np.inf, -np.inf


@compiled
def _begin_homing(state: Any, parameters: Any, time: float) -> None:
    s, p = state.control[0], parameters.control[0]
    if not change_state(s, parameters, State.HOMING, time):
        return
    s.homed, s.homing.agreed_since = False, time
    if p.home_by_index:
        begin_search(state, p, time)


@compiled
def _arm(state: Any, parameters: Any, time: float) -> None:
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    if not change_state(s, parameters, State.ARMED, time):
        return
    reset_integral(state.pid)
    s.disarming = s.tee = False
    s.air_from = time + p.warning_time
    # Set-point := measured; the move begins when the chambers are charged.
    begin_move(parameters, s, e.angle, s.air_from + p.precharge_time)


@compiled
def _begin_swing(s: Any, parameters: Any, time: float) -> None:
    if not change_state(s, parameters, State.SWINGING, time):
        return
    s.swinging, s.swing.start, s.swing.struck, s.swing.fastest_head = True, time, False, 0.0
    s.swings += 1
    # The integrals continue: the output of this tick also holds the damping term's noise.
    follow_profile(parameters, s, time)
