"""Functions that change the state, one at a time, on records alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from bench.base.lifecycle import (
    READINGS_LOST,
    READINGS_VALID,
    Cause,
    Phase,
    Reaction,
    State,
)
from bench.control.moves.braking import brake_opening
from bench.control.states import (
    begin_reaction,
    change_state,
    disarm,
    enter_hold,
    enter_standstill,
    filter_velocity,
    is_at_rest,
    is_slow_now,
    latch,
    latch_exception,
    react,
    resting_state,
)
from bench.control.step_records import ControlParameters, ControlState, new_control_state
from tests.bench.control.operating import at_power_up


@pytest.fixture(scope="module")
def built() -> ControlParameters:
    return at_power_up(hold_between_swings=True).parameters


@pytest.fixture
def bench(built: ControlParameters) -> tuple[ControlState, ControlParameters]:
    """Return a bench that stands in READY, and its parameters."""
    return new_control_state(State.READY), ControlParameters(*(record.copy() for record in built))


Bench = tuple[ControlState, ControlParameters]


def changed(bench: Bench, target: int) -> bool:
    """Change the state at 2.0 s, as compiled code does: by number."""
    change: Callable[..., bool] = change_state
    return change(bench[0].control[0], bench[1], int(target), 2.0)


@pytest.mark.parametrize(
    ("target", "kept"),
    [(State.ESTOP, False), (State.FAULT, False), (State.ACCESS, False), (State.ARMED, True)],
)
def test_change_state_to_latch_or_access_discards_press(bench: Bench, target: State, kept: bool) -> None:
    s = bench[0].control[0]
    s["reset_pressed"] = 0.5
    assert changed(bench, target)
    assert (s["state"], s["state_since"], s["reset_pressed"]) == (target, 2.0, 0.5 if kept else -np.inf)


@pytest.mark.parametrize("source", [State.READY, len(State), 255])
@pytest.mark.parametrize("emergency", [False, True])
def test_change_state_forbidden_at_standstill_latches_exception(
    bench: Bench, source: int, emergency: bool
) -> None:
    s = bench[0].control[0]
    s["state"], s["emergency"], s["securing"], s["reset_pressed"] = source, emergency, True, 0.5
    assert not changed(bench, State.SWINGING)
    assert (s["state"], s["state_since"]) == (State.ESTOP if emergency else State.FAULT, 2.0)
    assert (s["cause"], s["latest_cause"], s["reaction"]) == (Cause.EXCEPTION, Cause.EXCEPTION, Reaction.VENT)
    assert (s["securing"], s["reset_pressed"]) == (False, -np.inf)


def test_change_state_forbidden_in_motion_brakes_and_keeps_first_cause(bench: Bench) -> None:
    s = bench[0].control[0]
    s["state"], s["phase"], s["cause"] = State.ARMED, Phase.HOLD, Cause.GUARD
    assert not changed(bench, State.HOMING)
    assert (s["state"], s["cause"], s["latest_cause"]) == (State.ARMED, Cause.GUARD, Cause.EXCEPTION)
    assert (s["reaction"], s["reaction_start"]) == (Reaction.BRAKE, 2.0)


def test_filter_velocity_limits_velocity_and_halves_difference_in_time_constant(bench: Bench) -> None:
    s, p, e = bench[0].control[0], bench[1].control[0], bench[0].estimator[0]
    p["rest_speed"] = (1.0, 2.0, 4.0)
    for velocity, expected in (
        ((0.5, -7.0, np.nan), (0.75, -3.0, 6.0)),
        ((4.0, 1.0, -np.inf), (2.0, 0.5, 6.0)),
    ):
        s["filtered_velocity"], e["velocity"] = (1.0, 0.0, 0.0), velocity
        filter_velocity(s, p, e, 0.03)
        assert s["filtered_velocity"] == pytest.approx(expected)


@pytest.mark.parametrize("joint", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rest_up_to_rest_speed_of_each_joint(bench: Bench, joint: int, sign: float) -> None:
    s, p, e = bench[0].control[0], bench[1].control[0], bench[0].estimator[0]
    bound = p["rest_speed"][joint]
    for speed, rests in ((bound, True), (np.nextafter(bound, np.inf), False), (np.nan, False)):
        s["filtered_velocity"][joint] = e["velocity"][joint] = sign * speed
        assert is_at_rest(s, p) == is_slow_now(p, e) == rests


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
    s["cause"], s["emergency"], s["homed"], s["phase"] = cause, emergency, homed, Phase.HOLD
    under_way = ("swinging", "moving", "disarming", "air", "vented")
    for name in under_way:
        s[name] = True
    s["venting"]["emptied"] = True
    assert resting_state(s) == state
    enter_standstill(s, bench[1], 3.0)
    assert (s["state"], s["phase"]) == (state, Phase.STANDING)
    assert not any(s[name] for name in under_way)
    assert s["venting"][["emptied", "start", "empty_since"]].tolist() == (False, 3.0, 3.0)
    assert s["reaction"] == (Reaction.VENT if cause else Reaction.NONE)


def test_latch_keeps_first_cause_until_emergency(bench: Bench) -> None:
    s = bench[0].control[0]
    s["securing"] = True
    for cause, kept in (
        (Cause.GUARD, Cause.GUARD),
        (Cause.SUPERVISOR, Cause.GUARD),
        (Cause.EMERGENCY_STOP, Cause.EMERGENCY_STOP),
        (Cause.NETWORK_STOP, Cause.EMERGENCY_STOP),
        (Cause.GUARD, Cause.EMERGENCY_STOP),
    ):
        latch(s, bench[1], cause, 1.0)
        assert (s["cause"], s["latest_cause"]) == (kept, cause)
    assert (s["state"], s["reaction"], s["securing"]) == (State.ESTOP, Reaction.VENT, False)


@pytest.mark.parametrize(
    ("before", "after"), [(0, Cause.GUARD), (Cause.EMERGENCY_STOP,) * 2, (Cause.WRIST_AIR,) * 2]
)
def test_react_lasting_cause_keeps_later_cause_visible(bench: Bench, before: int, after: Cause) -> None:
    s = bench[0].control[0]
    s["phase"], s["cause"], s["latest_cause"] = Phase.DOWNSWING, Cause.GUARD, before
    for tick in range(3):
        react(*bench, int(Cause.GUARD), READINGS_VALID, 1.0 + 1e-3 * tick)
        assert (s["cause"], s["latest_cause"]) == (Cause.GUARD, after)


@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("cause", [Cause.GUARD, Cause.EMERGENCY_STOP])
def test_react_emergency_is_kept(bench: Bench, before: bool, cause: Cause) -> None:
    s = bench[0].control[0]
    s["phase"], s["emergency"] = Phase.DOWNSWING, before
    react(*bench, int(cause), READINGS_VALID, 1.0)
    assert (s["emergency"], s["cause"]) == (before or cause is Cause.EMERGENCY_STOP, cause)
    assert (s["phase"], s["reaction"]) == (Phase.DOWNSWING, Reaction.BRAKE)


def test_react_lost_reading_at_rest_vents_and_suspects_encoders(bench: Bench) -> None:
    state, parameters = bench
    s = state.control[0]
    react(state, parameters, int(Cause.ARM_ENCODER), READINGS_LOST, 1.0)
    assert (s["state"], s["reaction"], s["cause"]) == (State.FAULT, Reaction.VENT, Cause.ARM_ENCODER)
    assert s["encoders_suspect"]
    react(state, parameters, int(Cause.GUARD), READINGS_VALID, 2.0)
    assert (s["cause"], s["latest_cause"], s["encoders_suspect"]) == (Cause.ARM_ENCODER, Cause.GUARD, True)


def test_react_misfit_suspects_encoders_and_index_clears_homed(bench: Bench) -> None:
    s = bench[0].control[0]
    kinds = ("FOLLOWING", "AIR", "VELOCITY", "JUMP", "EFFORT", "FLOW", "SENSOR", "ZERO")
    misfits = {f"{joint}_{kind}" for joint in ("SHOULDER", "ARM", "WRIST") for kind in kinds}
    for cause in list(Cause)[1:]:
        s["phase"], s["homed"], s["encoders_suspect"] = Phase.DOWNSWING, True, False
        react(*bench, int(cause), READINGS_VALID, 1.0)
        assert s["encoders_suspect"] == (cause.name in misfits), cause.name
        assert s["homed"] == (not cause.name.endswith("_INDEX")), cause.name


@pytest.mark.parametrize(
    ("phase", "air", "before", "reaction", "after"),
    [
        (Phase.HOLD, True, State.ARMED, Reaction.NONE, State.READY),
        (Phase.RETURN, False, State.ARMED, Reaction.NONE, State.READY),
        (Phase.RETURN, True, State.ARMED, Reaction.NONE, State.RECOVERING),
        (Phase.HOMING, True, State.HOMING, Reaction.NONE, State.HOMING),
        (Phase.RETURN, True, State.RECOVERING, Reaction.BRAKE, State.RECOVERING),
    ],
)
def test_disarm_vents_at_hold_and_brakes_in_motion(
    bench: Bench, phase: Phase, air: bool, before: State, reaction: Reaction, after: State
) -> None:
    s = bench[0].control[0]
    s["phase"], s["state"], s["reaction"], s["air"], s["moving"] = phase, before, reaction, air, True
    disarm(s, bench[1], 1.0)
    assert s["state"] == after
    assert s["reaction"] == (Reaction.NONE if after is State.READY else Reaction.BRAKE)
    assert s["moving"] == (reaction is Reaction.BRAKE)  # a brake under way goes on


@pytest.mark.parametrize(
    ("before", "differs", "reaction", "after"),
    [
        (State.ARMED, "lease_held", Reaction.NONE, State.ARMED),
        (State.RECOVERING, "", Reaction.NONE, State.ARMED),
        (State.RECOVERING, "lease_held", Reaction.NONE, State.READY),
        (State.RECOVERING, "support_ready", Reaction.NONE, State.READY),
        (State.RECOVERING, "disarming", Reaction.NONE, State.READY),
        (State.RECOVERING, "hold_between_swings", Reaction.NONE, State.READY),
        (State.RECOVERING, "", Reaction.COMPLETE, State.RECOVERING),
    ],
)
def test_enter_hold_returns_to_armed_in_series(
    bench: Bench, before: State, differs: str, reaction: Reaction, after: State
) -> None:
    s, p = bench[0].control[0], bench[1].control[0]
    s["phase"], s["state"], s["reaction"], s["moving"] = Phase.RETURN, before, reaction, True
    if differs:
        record = p if differs == "hold_between_swings" else s
        record[differs] = not record[differs]
    enter_hold(s, bench[1], 1.0)
    assert (s["state"], s["moving"]) == (after, False)
    assert s["phase"] == (Phase.STANDING if after is State.READY else Phase.HOLD)


def test_latch_exception_clears_activity_and_faults(bench: Bench) -> None:
    control = bench[0].control
    control["phase"], control["state"] = Phase.BACKSWING, State.SWINGING
    under_way = ("swinging", "moving", "disarming", "air", "vented", "tee")
    for name in under_way:
        control[name] = True
    control["venting"]["emptied"] = True
    latch_exception(control, bench[1], 1.0)
    s = control[0]
    assert not any(s[name] for name in under_way)
    assert (s["phase"], s["state"]) == (Phase.STANDING, State.FAULT)
    assert s["venting"][["emptied", "start", "empty_since"]].tolist() == (False, 1.0, 1.0)
    assert (s["cause"], s["reaction"]) == (Cause.EXCEPTION, Reaction.PASSIVE)


def test_brake_opening_opposes_motion_and_fades() -> None:
    law = (0.1, 0.01, 1.0)
    assert brake_opening(*law, 2.0, 0.0) == pytest.approx(-0.2)
    assert brake_opening(*law, -2.0, 0.0) == pytest.approx(0.2)
    assert brake_opening(*law, 0.5, 0.0) == pytest.approx(-0.025)
    assert np.isnan(brake_opening(*law, np.nan, 0.0))
