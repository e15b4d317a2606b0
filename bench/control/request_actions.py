"""Actions of accepted requests; stops are not carried out here."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Reaction, Request, State
from bench.control.law.pid import reset_integral
from bench.control.moves.homing import begin_search
from bench.control.moves.references import begin_move, follow_profile
from bench.control.states import change_state, disarm
from drivers.base.compiled import compiled


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
