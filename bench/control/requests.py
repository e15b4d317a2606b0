"""Requests to the bench: each is carried out or refused, with the reason, in the tick it is put to."""

from __future__ import annotations

from typing import Any

from bench.control.envelope import interlock_cause
from bench.lifecycle import Answer, Cause, Phase, Reaction, Refusal, Request
from drivers.base.compiled import compiled

_ACCEPTED, _REFUSED = int(Answer.ACCEPTED), int(Answer.REFUSED)
_SWING, _RESET, _STOP = int(Request.SWING), int(Request.RESET), int(Request.STOP)
_EMERGENCY_STOP, _HOME, _ACCESS = int(Request.EMERGENCY_STOP), int(Request.HOME), int(Request.ACCESS)
_ARM, _SECURE = int(Request.ARM), int(Request.SECURE)
_HOLD, _STANDING = int(Phase.HOLD), int(Phase.STANDING)
_COMPLETE = int(Reaction.COMPLETE)
_EMERGENCY_CAUSE = int(Cause.EMERGENCY_STOP)

_BY_STATE, _STOPPING, _E_STOP = int(Refusal.STATE), int(Refusal.STOPPING), int(Refusal.EMERGENCY_STOP)
_GUARD, _READINGS, _NOT_AT_ADDRESS = int(Refusal.GUARD), int(Refusal.READINGS), int(Refusal.NOT_AT_ADDRESS)
_NO_LEASE, _SUPPORT, _NOT_VENTED = int(Refusal.NO_LEASE), int(Refusal.SUPPORT), int(Refusal.NOT_VENTED)
_LOCAL_RESET, _READ_ONLY, _SUPERVISOR, _DEVICE = (
    int(Refusal.LOCAL_RESET), int(Refusal.READ_ONLY), int(Refusal.SUPERVISOR), int(Refusal.DEVICE),
)  # fmt: skip


@compiled
def near_address(parameters: Any, estimator: Any) -> bool:
    """Tell whether every joint is at the address within its tolerance and at rest."""
    p, e = parameters.control[0], estimator[0]
    for i in range(3):
        if not abs(e.angle[i] - parameters.angle[0, i]) <= p.address_tolerance[i]:
            return False
        if not abs(e.velocity[i]) <= 2.0 * p.still_speed[i]:
            return False
    return True


@compiled
def note_local_reset(s: Any, pressed: bool, time: float) -> None:
    """Remember when the local reset was last pressed; a level that was never seen low is no press."""
    if pressed and s.reset_was_low:
        s.reset_pressed = time
        s.reset_was_low = False
    elif not pressed:
        s.reset_was_low = True


@compiled
def refusal_of(state: Any, parameters: Any, readings: Any, request: int, time: float) -> int:
    """Return why `request` cannot be carried out now, or 0; a stop never is refused."""
    s, p = state.control[0], parameters.control[0]
    if request in (_STOP, _EMERGENCY_STOP):
        return 0
    if p.read_only:
        return _READ_ONLY
    if request >= len(p.accepted) or p.accepted[request, s.state] == 0:
        return _BY_STATE
    if s.reaction > _COMPLETE and s.phase != _STANDING:
        return _STOPPING
    if p.needs_lease[request] != 0 and not s.lease_held:
        return _NO_LEASE
    # A passive device obeys nothing; the reset sets it to work again.
    if not s.device_operational and request in (_ARM, _SWING, _HOME, _ACCESS):
        return _DEVICE
    if request == _ACCESS:
        if interlock_cause(readings) == _EMERGENCY_CAUSE:
            return _E_STOP
        return 0 if s.vented else _NOT_VENTED
    if request == _SECURE:
        return 0 if readings[0].guard_closed else _GUARD
    if request in (_ARM, _SWING, _RESET, _HOME):
        interlock = interlock_cause(readings)
        if interlock != 0:
            return _E_STOP if interlock == _EMERGENCY_CAUSE else _GUARD
        if s.lost != 0:
            return _READINGS
        if not s.supervisor_alive:
            return _SUPERVISOR
    if request in (_ARM, _SWING):
        if not s.support_ready:
            return _SUPPORT
    if request == _SWING:
        if s.phase != _HOLD or s.swinging or not near_address(parameters, state.estimator):
            return _NOT_AT_ADDRESS
    if not s.vented:
        if request == _HOME and not p.home_by_index:  # the pose proves something of a robot without air only
            return _NOT_VENTED
        if request == _RESET and time - s.vent_start >= p.vent_time:
            return _NOT_VENTED
    # `not <=` so that a time that is no number refuses.
    if request == _RESET and p.local_reset and not time - s.reset_pressed <= p.local_reset_time:
        return _LOCAL_RESET
    return 0


@compiled
def take_request(state: Any, parameters: Any, readings: Any, time: float) -> int:
    """Answer the request put to this tick; return it when it was accepted, else 0."""
    s = state.control[0]
    request = s.request
    s.request = 0
    s.asked = request
    if request == 0:
        return 0
    # A stop comes past the numbered requests: the answer to the last one may not have been read yet.
    if request in (_STOP, _EMERGENCY_STOP) and s.answered_number == s.request_number != 0:
        return int(request)
    s.answered_number = s.request_number
    s.refusal = refusal_of(state, parameters, readings, request, time)
    if s.refusal != 0:
        s.answer = _REFUSED
        return 0
    s.answer = _ACCEPTED
    return int(request)
