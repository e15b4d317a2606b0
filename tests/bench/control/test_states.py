"""The state changes along TRANSITIONS only: any other change is a fault in its tick."""

from __future__ import annotations

import numpy as np
import pytest

from bench.base.lifecycle import (
    READINGS_LOST,
    READINGS_VALID,
    TRANSITIONS,
    Cause,
    Phase,
    Reaction,
    Request,
    State,
)
from bench.control.moves.braking import brake_opening
from bench.control.states import (
    begin_reaction,
    disarm,
    enter_hold,
    enter_standstill,
    latch,
    latch_exception,
    react,
)
from bench.control.step_records import ControlParameters, ControlState, new_control_state
from tests.bench.control.operating import at_power_up, do, on_the_way, reach
from tests.bench.control.puppet import Puppet


def forbid(puppet: Puppet, source: State, target: State) -> None:
    """Take a way out of the matrix of `puppet` alone."""
    puppet.parameters = puppet.parameters._replace(control=puppet.parameters.control.copy())
    puppet.parameters.control["transitions"][0, source, target] = 0


@pytest.mark.parametrize(
    ("source", "request_", "target"),
    [
        (State.READY, Request.ARM, State.ARMED),
        (State.READY, Request.HOME, State.HOMING),
        (State.READY, Request.ACCESS, State.ACCESS),
        (State.FAULT, Request.RESET, State.READY),
        (State.SAFE, Request.ACCESS, State.ACCESS),
    ],
    ids=lambda value: value.name,
)
def test_forbidden_transition_on_request_faults_in_same_tick(
    source: State, request_: Request, target: State
) -> None:
    puppet = reach(source)
    forbid(puppet, source, target)
    do(request_)(puppet)
    assert (puppet.bench, puppet.phase, puppet.reaction) == (State.FAULT, Phase.STANDING, Reaction.VENT)
    assert puppet.control["latest_cause"] == Cause.EXCEPTION
    assert puppet.cause == (Cause.SUPERVISOR if source is State.FAULT else Cause.EXCEPTION)
    assert not puppet.record["supply_enable"][0]


def test_forbidden_transition_to_swinging_brakes() -> None:
    puppet = reach(State.ARMED)
    forbid(puppet, State.ARMED, State.SWINGING)
    puppet.tick(Request.SWING)
    assert (puppet.bench, puppet.reaction, puppet.cause) == (State.ARMED, Reaction.BRAKE, Cause.EXCEPTION)
    assert not puppet.control["swinging"]
    puppet.run(100)
    assert (puppet.bench, puppet.phase) == (State.FAULT, Phase.STANDING)


def test_forbidden_transition_in_motion_brakes_in_same_tick() -> None:
    puppet = on_the_way()
    forbid(puppet, State.ARMED, State.RECOVERING)
    puppet.tick(Request.DISARM)
    assert (puppet.bench, puppet.reaction, puppet.cause) == (State.ARMED, Reaction.BRAKE, Cause.EXCEPTION)
    puppet.run(100)
    assert (puppet.bench, puppet.phase) == (State.FAULT, Phase.STANDING)


@pytest.mark.parametrize("state", [len(State), 255])
def test_unknown_state_latches_fault(state: int) -> None:
    puppet = reach(State.READY)
    puppet.control["state"] = state
    puppet.give(supervisor_alive=False).tick()
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.SUPERVISOR)
    assert puppet.control["latest_cause"] == Cause.EXCEPTION


def test_forbidden_transition_to_estop_keeps_emergency() -> None:
    puppet = reach(State.READY)
    forbid(puppet, State.READY, State.ESTOP)
    puppet.give(emergency_stop_clear=False).tick()
    assert (puppet.bench, puppet.cause) == (State.ESTOP, Cause.EMERGENCY_STOP)
    assert puppet.control["latest_cause"] == Cause.EXCEPTION


def test_reset_after_forbidden_transition_returns_to_ready() -> None:
    puppet = reach(State.READY)
    forbid(puppet, State.READY, State.ARMED)
    puppet.tick(Request.ARM)
    assert (State.FAULT, State.READY) in {(edge.source, edge.target) for edge in TRANSITIONS}
    puppet.run(40)
    puppet.tick(Request.RESET)
    assert (puppet.bench, puppet.cause) == (State.READY, Cause.NONE)


# One function at a time -------------------------------------------------------------------------------


@pytest.fixture
def bench() -> tuple[ControlState, ControlParameters]:
    """Return a bench that stands in READY, and its parameters."""
    return new_control_state(State.READY), at_power_up(hold_between_swings=True).parameters


Bench = tuple[ControlState, ControlParameters]


def test_begin_reaction_less_severe_keeps_current(bench: Bench) -> None:
    state, parameters = bench
    s = state.control[0]
    for reaction, began in ((Reaction.BRAKE, True), (Reaction.COMPLETE, False), (Reaction.BRAKE, False)):
        assert begin_reaction(s, parameters, reaction, 1.0) is began
        assert s["reaction"] == Reaction.BRAKE
    assert begin_reaction(s, parameters, Reaction.PASSIVE, 2.0)
    assert s["reaction_start"] == s["still_since"] == 2.0


@pytest.mark.parametrize(("swinging", "sample", "row"), [(True, 32, 1), (True, 10**6, 4), (False, 32, -1)])
def test_begin_reaction_blind_brake_starts_at_row_of_sample(
    bench: Bench, swinging: bool, sample: int, row: int
) -> None:
    state, parameters = bench
    s = state.control[0]
    s["swinging"], s["swing"]["sample"] = swinging, sample
    assert parameters.profile["blind_spacing"][0] == 20
    begin_reaction(s, parameters, Reaction.BLIND_BRAKE, 0.0)
    assert s["blind_row"] == row


@pytest.mark.parametrize("before", [Reaction.NONE, Reaction.COMPLETE])
def test_begin_reaction_blind_brake_opens_loop_of_all_joints(bench: Bench, before: Reaction) -> None:
    state, parameters = bench
    s = state.control[0]
    s["swinging"], s["swing"]["sample"] = True, 32
    begin_reaction(s, parameters, before, 1.0)
    begin_reaction(s, parameters, Reaction.BLIND_BRAKE, 1.1)
    assert (s["blind_row"], s["open_loop_joints"].tolist()) == (1, [1, 1, 1])


def test_begin_reaction_blind_brake_after_brake_skips_pattern(bench: Bench) -> None:
    state, parameters = bench
    s = state.control[0]
    s["swinging"], s["swing"]["sample"], s["open_loop_joints"] = True, 32, 1
    begin_reaction(s, parameters, Reaction.BRAKE, 1.0)
    begin_reaction(s, parameters, Reaction.BLIND_BRAKE, 1.1)
    assert (s["reaction"], s["reaction_start"], s["still_since"]) == (Reaction.BLIND_BRAKE, 1.1, 1.1)
    assert (s["blind_row"], s["open_loop_joints"].tolist()) == (-1, [0, 0, 0])
    begin_reaction(s, parameters, Reaction.PASSIVE, 1.2)
    assert (s["reaction_start"], s["still_since"]) == (1.2, 1.2)


@pytest.mark.parametrize(
    ("cause", "emergency", "homed", "state"),
    [
        (Cause.GUARD, False, True, State.FAULT),
        (Cause.EMERGENCY_STOP, True, True, State.ESTOP),
        (Cause.NONE, False, True, State.READY),
        (Cause.NONE, False, False, State.SAFE),
    ],
)
def test_enter_standstill_latches_cause(
    bench: Bench, cause: Cause, emergency: bool, homed: bool, state: State
) -> None:
    s = bench[0].control[0]
    s["cause"], s["emergency"], s["homed"], s["phase"], s["air"] = cause, emergency, homed, Phase.HOLD, True
    enter_standstill(s, bench[1], 3.0)
    assert (s["state"], s["phase"], bool(s["air"]), s["venting"]["start"]) == (
        state,
        Phase.STANDING,
        False,
        3.0,
    )
    assert s["reaction"] == (Reaction.VENT if cause else Reaction.NONE)


def test_latch_keeps_first_cause_until_emergency(bench: Bench) -> None:
    s = bench[0].control[0]
    for cause, kept in (
        (Cause.GUARD, Cause.GUARD),
        (Cause.SUPERVISOR, Cause.GUARD),
        (Cause.EMERGENCY_STOP, Cause.EMERGENCY_STOP),
        (Cause.NETWORK_STOP, Cause.EMERGENCY_STOP),
    ):
        latch(s, bench[1], cause, 1.0)
        assert (s["cause"], s["latest_cause"]) == (kept, cause)
    assert s["state"] == State.ESTOP


def test_react_lasting_cause_keeps_later_cause_visible() -> None:
    puppet = reach(State.SWINGING)
    s = puppet.state.control[0]
    for tick in range(3):
        react(puppet.state, puppet.parameters, int(Cause.GUARD), READINGS_VALID, 1.0 + 1e-3 * tick)
        assert (s["cause"], s["latest_cause"]) == (Cause.GUARD, Cause.GUARD)
    react(puppet.state, puppet.parameters, int(Cause.WRIST_AIR), READINGS_VALID, 1.003)
    react(puppet.state, puppet.parameters, int(Cause.GUARD), READINGS_VALID, 1.004)
    assert (s["cause"], s["latest_cause"]) == (Cause.GUARD, Cause.WRIST_AIR)


def test_react_lost_reading_at_rest_vents_and_suspects_encoders(bench: Bench) -> None:
    state, parameters = bench
    s = state.control[0]
    react(state, parameters, int(Cause.ARM_ENCODER), READINGS_LOST, 1.0)
    assert (s["state"], s["reaction"], s["cause"]) == (State.FAULT, Reaction.VENT, Cause.ARM_ENCODER)
    assert s["encoders_suspect"]
    react(state, parameters, int(Cause.GUARD), READINGS_VALID, 2.0)
    assert (s["cause"], s["latest_cause"]) == (Cause.ARM_ENCODER, Cause.GUARD)


@pytest.mark.parametrize("joint", range(3))
def test_react_following_error_suspects_encoders(joint: int) -> None:
    puppet = reach(State.SWINGING)
    react(puppet.state, puppet.parameters, int(Cause.SHOULDER_FOLLOWING) + joint, READINGS_VALID, 1.0)
    assert puppet.control["encoders_suspect"]


@pytest.mark.parametrize(
    ("phase", "before", "reaction", "after"),
    [
        (Phase.HOLD, State.ARMED, Reaction.NONE, State.READY),
        (Phase.RETURN, State.ARMED, Reaction.NONE, State.RECOVERING),
        (Phase.HOMING, State.HOMING, Reaction.NONE, State.HOMING),
        (Phase.RETURN, State.RECOVERING, Reaction.BRAKE, State.RECOVERING),
    ],
)
def test_disarm_vents_at_hold_and_brakes_in_motion(
    bench: Bench, phase: Phase, before: State, reaction: Reaction, after: State
) -> None:
    s = bench[0].control[0]
    s["phase"], s["state"], s["reaction"], s["air"], s["moving"] = phase, before, reaction, True, True
    disarm(s, bench[1], 1.0)
    assert s["state"] == after
    assert s["reaction"] == (Reaction.NONE if phase is Phase.HOLD else Reaction.BRAKE)


@pytest.mark.parametrize(
    ("before", "held", "reaction", "after"),
    [
        (State.ARMED, True, Reaction.NONE, State.ARMED),
        (State.RECOVERING, True, Reaction.NONE, State.ARMED),
        (State.RECOVERING, False, Reaction.NONE, State.READY),
        (State.RECOVERING, True, Reaction.COMPLETE, State.RECOVERING),
    ],
)
def test_enter_hold_returns_to_armed_in_series(
    bench: Bench, before: State, held: bool, reaction: Reaction, after: State
) -> None:
    s = bench[0].control[0]
    s["phase"], s["state"], s["reaction"], s["lease_held"] = Phase.RETURN, before, reaction, held
    enter_hold(s, bench[1], 1.0)
    assert s["state"] == after


@pytest.mark.parametrize("cause", [Cause.SHOULDER_INDEX, Cause.WRIST_INDEX], ids=lambda cause: cause.name)
def test_react_index_cause_clears_homed(bench: Bench, cause: Cause) -> None:
    s = bench[0].control[0]
    s["homed"] = True
    react(bench[0], bench[1], cause, READINGS_VALID, 1.0)
    assert not s["homed"]


def test_latch_exception_clears_activity_and_faults(bench: Bench) -> None:
    control = bench[0].control
    control["phase"], control["state"], control["swinging"] = Phase.BACKSWING, State.SWINGING, True
    under_way = ("swinging", "moving", "disarming", "air", "vented", "tee")
    for name in under_way:
        control[name] = True
    latch_exception(control, bench[1], 1.0)
    s = control[0]
    assert not any(s[name] for name in under_way)
    assert (s["phase"], s["state"], s["venting"]["start"]) == (Phase.STANDING, State.FAULT, 1.0)
    assert (s["cause"], s["reaction"]) == (Cause.EXCEPTION, Reaction.PASSIVE)


def test_brake_opening_opposes_motion_and_fades() -> None:
    law = (0.1, 0.01, 1.0)
    assert brake_opening(*law, 2.0, 0.0) == pytest.approx(-0.2)
    assert brake_opening(*law, -2.0, 0.0) == pytest.approx(0.2)
    assert brake_opening(*law, 0.5, 0.0) == pytest.approx(-0.025)
    assert np.isnan(brake_opening(*law, np.nan, 0.0))
