"""The desired valve commands of a swing, a slow move, an index search and the hold at the address."""

from __future__ import annotations

from typing import Any

from bench.base.lifecycle import Phase, Reaction, State
from bench.control.law.feed_forward import NONE, PNEUMATIC
from bench.control.law.gain_table import (
    DAMPING,
    DERIVATIVE,
    MOVE,
    PROPORTIONAL,
    interpolate_gains,
    middle_pose,
)
from bench.control.law.pid import control, reset_integral
from bench.control.moves.address_pressure import (
    HELD,
    dither_move,
    leave_address_air,
    precharge,
    regulate_address_pressure,
    take_over_unsettled_move,
)
from bench.control.moves.braking import brake_openings, lift
from bench.control.moves.first_motion import bound_first, note_answers, owes_answer
from bench.control.moves.homing import search
from bench.control.moves.references import (
    begin_move,
    charging,
    feed_model_forward,
    follow_move,
    follow_profile,
    square_wave,
)
from bench.control.states import begin_reaction, change_state, enter_hold, near_address
from drivers.base.compiled import compiled


@compiled
def follow(state: Any, parameters: Any, time: float, measured_step: float) -> None:
    """Advance the swing, slow move, search or hold and compute the desired valve commands."""
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    if s.swinging:
        _follow_swing(state, parameters, time)
    elif s.phase == Phase.HOMING:
        if charging(s, time):
            reset_integral(state.pid)
        if search(s, p, e, state.pid[0], state.encoder[0].indexed, time, measured_step):
            s.homed = True
            begin_reaction(s, parameters, Reaction.BRAKE.value, time)  # no cause: to rest, then READY
    elif s.moving:
        if time < s.air_from or (s.move.is_test and charging(s, time)):
            # A vented robot may still sink while it warns, and air may turn a joint whose valve is bounded:
            # the move begins where it is by then.
            begin_move(parameters, s, e.angle, s.move.start)
        owed = owes_answer(s, 0) or owes_answer(s, 1) or owes_answer(s, 2)
        if not (follow_move(parameters, s, time) or owed):
            _end_move(state, parameters, time)
    else:
        for i in range(3):
            # Near enough is left alone: with dry friction an integral would hunt for ever.
            away = parameters.angle[0, i] - e.angle[i]
            moved = abs(away) > p.address_deadband[i] and s.address_air.held[i] & HELD == 0
            s.reference[i] = parameters.angle[0, i] if moved else e.angle[i]
            s.reference_velocity[i] = s.reference_acceleration[i] = s.feed_forward[i] = 0.0
    if s.phase == Phase.FOLLOW_THROUGH:
        brake_openings(s, p, e)
        lift(s, p, e)
    else:
        _control_openings(state, parameters, time, measured_step)


@compiled
def _end_move(state: Any, parameters: Any, time: float) -> None:
    """Hold the address once the robot is there; after a test motion go there."""
    s, e = state.control[0], state.estimator
    if s.move.is_test:
        begin_move(parameters, s, s.reference, time)
    elif near_address(parameters, e) or take_over_unsettled_move(s, parameters, e[0], time):
        enter_hold(s, parameters, time)


@compiled
def _follow_swing(state: Any, parameters: Any, time: float) -> None:
    """Move the swing on; after its end brake if a stop is under way, otherwise return to the address."""
    s, e = state.control[0], state.estimator[0]
    if follow_profile(parameters, s, time):
        return
    s.swinging = s.tee = False
    if s.reaction == Reaction.COMPLETE:
        begin_reaction(
            s, parameters, Reaction.BRAKE.value, time
        )  # the planned braking is done; BRAKE holds until rest is proven
    else:
        reset_integral(state.pid)
        begin_move(parameters, s, e.angle, time)
        follow_move(parameters, s, time)
        change_state(s, parameters, State.RECOVERING, time)


@compiled
def _control_openings(state: Any, parameters: Any, time: float, measured_step: float) -> None:
    """Set the desired valve commands (3,): PID, feed-forward, damping, charging and dither."""
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    _take_gains(s, p, state.pid[0], parameters.pid[0])
    if s.swinging and p.feed_forward == PNEUMATIC:
        feed_model_forward(state, parameters, time)
    for i in range(3):
        if p.feed_forward == NONE:
            s.feed_forward[i] = 0.0
        # The impact's jump is no motion to be damped.
        if s.phase != Phase.IMPACT:
            share = p.downswing_damping if s.phase in (Phase.DOWNSWING, Phase.COMMITTED) else 1.0
            damping = share * state.pid[0].gains[DAMPING, i]
            s.feed_forward[i] += damping * (s.reference_acceleration[i] - e.acceleration[i])
    terms = (s.reference, s.reference_velocity, e.angle, e.velocity, s.feed_forward)
    control(state.pid, *terms, measured_step)
    note_answers(s, state.pid[0], e)
    push = side = 0.0
    planned = parameters.profile[0].air_planned and s.phase != Phase.HOMING
    if charging(s, time) and not planned:
        # A closed-centre spool fills one chamber while it empties the other. Swung around the centre it
        # passes as much in as out of both, which ends at about three quarters of the supply in each.
        push = p.precharge_opening * square_wave((time - s.move.start) / p.precharge_period)
    elif s.phase in (Phase.BACKSWING, Phase.TOP) and time - s.swing.start >= p.dither_delay:
        side = square_wave((time - s.swing.start) / p.dither_period)
    for i in range(3):
        opening = state.pid[0].output[i] + push + side * p.dither[i]
        s.desired[i] = bound_first(s, p, i, opening)
    if planned:
        _serve_air(state, parameters, time)


@compiled
def _take_gains(s: Any, c: Any, d: Any, p: Any) -> None:
    """Set the gains of this tick by the reference's pose.

    `c` is CONTROL_PARAMETERS, `d` PID_STATE, `p` PID_PARAMETERS.
    """
    factor = d.supply_factor if d.supply_factor > 0.0 else 1.0
    if s.homed:
        interpolate_gains(d.gains, p, s.reference, factor)
    else:
        interpolate_gains(d.gains, p, middle_pose(p), factor)
    if s.phase in (Phase.DOWNSWING, Phase.COMMITTED):
        for i in range(3):
            d.gains[PROPORTIONAL, i] *= c.downswing_gain_factor
            d.gains[DERIVATIVE, i] *= c.downswing_gain_factor
    for i in range(3):
        s.move.gain[i] = d.gains[MOVE, i]


@compiled
def _serve_air(state: Any, parameters: Any, time: float) -> None:
    """Adjust the desired valve commands (3,) in phases that regulate the chamber pressures."""
    s = state.control[0]
    if s.phase == Phase.HOLD and not s.swinging:
        regulate_address_pressure(state, parameters, time)
        return
    leave_address_air(s, time)
    if charging(s, time):
        precharge(state, parameters, time)
    elif s.moving:
        dither_move(state, parameters, time)
