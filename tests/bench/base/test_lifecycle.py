"""The stopping table is complete, in order, and the one of the design with its shown departure."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import pytest

from bench.base.lifecycle import (
    ACCEPTED_IN,
    ACTUATOR_FAULT,
    CAUSE_TEXT,
    CHAMBER_SUSPECT,
    EMERGENCIES,
    EMERGENCY,
    NEEDS_LEASE,
    PASSING,
    READINGS_LOST,
    READINGS_VALID,
    REFUSAL_TEXT,
    REFUSAL_WORDS,
    STOP_REACTIONS,
    TRANSITIONS,
    WRIST_FAULT,
    Answer,
    Cause,
    Phase,
    Reaction,
    Refusal,
    Request,
    State,
    accepted_table,
    reaction_table,
    transition_table,
)
from bench.control.envelope import PHASES
from bench.control.step_records import CONTROL_PARAMETERS

SLOW = {Phase.HOMING, Phase.HOLD, Phase.BACKSWING, Phase.TOP, Phase.RETURN}
SHOCK = {Phase.IMPACT, Phase.FOLLOW_THROUGH}
MOVING = set(Phase) - {Phase.STANDING}


@pytest.mark.parametrize("kind", [Phase, Reaction, Cause])
def test_lifecycle_enums_are_contiguous_from_zero(kind: type[IntEnum]) -> None:
    assert [member.value for member in kind] == list(range(len(kind)))


def test_accepted_table_matches_accepted_in_with_stop_in_every_state() -> None:
    table = np.array(accepted_table())
    assert table.shape == (len(Request), len(State))
    for request, state in np.ndindex(table.shape):
        assert bool(table[request, state]) is (State(state) in ACCEPTED_IN[Request(request)])
    assert table[[Request.STOP, Request.EMERGENCY_STOP]].all()
    assert not table[Request.NONE].any()


@pytest.mark.parametrize(("texts", "kind"), [(CAUSE_TEXT, Cause), (REFUSAL_TEXT, Refusal)])
def test_text_is_unique_for_every_cause_and_refusal(texts: dict[IntEnum, str], kind: type[IntEnum]) -> None:
    assert set(texts) == set(kind)
    assert len(set(texts.values())) == len(kind)
    for text in texts.values():
        assert text.strip() == text != ""


def test_not_vented_action_requests_emergency_stop() -> None:
    action = "keep away from the robot; press the emergency stop, then open the hand valves"
    assert CAUSE_TEXT[Cause.NOT_VENTED].endswith(action)


def test_gauge_refusal_action_locks_supply_first() -> None:
    action = "lock the supply; once both gauges show 0, press the local reset, then retry"
    assert REFUSAL_WORDS[Refusal.GAUGE][1] == action


def test_cause_joints_have_consecutive_numbers() -> None:
    names = (
        "ENCODER",
        "RANGE",
        "SPEED",
        "FOLLOWING",
        "STOP_DISTANCE",
        "AIR",
        "VELOCITY",
        "JUMP",
        "EFFORT",
        "FLOW",
        "SENSOR",
    )
    for name in names:
        first = Cause[f"SHOULDER_{name}"]
        assert [Cause[f"{joint}_{name}"] - first for joint in ("SHOULDER", "ARM", "WRIST")] == [0, 1, 2]


def test_reaction_table_covers_every_phase_and_column() -> None:
    assert list(STOP_REACTIONS) == list(Phase)
    assert {READINGS_VALID, READINGS_LOST, EMERGENCY, ACTUATOR_FAULT, WRIST_FAULT, CHAMBER_SUSPECT} == set(
        range(6)
    )
    for row in STOP_REACTIONS.values():
        assert len(row) == 6
        assert Reaction.NONE not in row
    table = np.array(reaction_table())
    assert table.shape == CONTROL_PARAMETERS["reactions"].shape == (PHASES, 6)
    for phase, column in np.ndindex(table.shape):
        assert Reaction(int(table[phase, column])) is STOP_REACTIONS[Phase(phase)][column]


def test_stop_reactions_standing_vents() -> None:
    assert set(STOP_REACTIONS[Phase.STANDING]) == {Reaction.VENT}


def test_stop_reactions_moving_never_vents() -> None:
    assert not any(Reaction.VENT in STOP_REACTIONS[phase] for phase in MOVING)


@pytest.mark.parametrize("phase", sorted(MOVING))
def test_stop_reactions_readings_lost_uses_open_loop_brake(phase: Phase) -> None:
    assert STOP_REACTIONS[phase][READINGS_LOST] is Reaction.BLIND_BRAKE


@pytest.mark.parametrize("phase", sorted(SLOW | {Phase.DOWNSWING}))
def test_stop_reactions_before_committed_brakes(phase: Phase) -> None:
    assert STOP_REACTIONS[phase][READINGS_VALID] is STOP_REACTIONS[phase][EMERGENCY] is Reaction.BRAKE


def test_stop_reactions_committed_brakes_only_for_emergency() -> None:
    row = STOP_REACTIONS[Phase.COMMITTED]
    assert (row[READINGS_VALID], row[EMERGENCY]) == (Reaction.COMPLETE, Reaction.BRAKE)


@pytest.mark.parametrize("phase", sorted(SHOCK))
def test_stop_reactions_from_impact_completes_swing(phase: Phase) -> None:
    assert {STOP_REACTIONS[phase][column] for column in (READINGS_VALID, EMERGENCY, WRIST_FAULT)} == {
        Reaction.COMPLETE
    }


def test_stop_reactions_actuator_fault_is_passive() -> None:
    assert {STOP_REACTIONS[phase][ACTUATOR_FAULT] for phase in MOVING} == {Reaction.PASSIVE}


def test_stop_reactions_wrist_fault_is_passive_only_in_slow_phases() -> None:
    assert {phase for phase in MOVING if STOP_REACTIONS[phase][WRIST_FAULT] is Reaction.PASSIVE} == SLOW
    fast = MOVING - SLOW - SHOCK
    assert {STOP_REACTIONS[phase][WRIST_FAULT] for phase in fast} == {Reaction.BRAKE}


def test_stop_reactions_chamber_suspect_is_passive_only_in_slow_phases() -> None:
    assert {phase for phase in MOVING if STOP_REACTIONS[phase][CHAMBER_SUSPECT] is Reaction.PASSIVE} == SLOW
    assert {STOP_REACTIONS[phase][CHAMBER_SUSPECT] for phase in (Phase.DOWNSWING, Phase.COMMITTED)} == {
        Reaction.BRAKE
    }
    assert {STOP_REACTIONS[phase][CHAMBER_SUSPECT] for phase in SHOCK} == {Reaction.COMPLETE}


def test_reaction_severity_rises_from_complete_to_vent() -> None:
    order = [
        Reaction.NONE,
        Reaction.COMPLETE,
        Reaction.BRAKE,
        Reaction.BLIND_BRAKE,
        Reaction.PASSIVE,
        Reaction.VENT,
    ]
    assert sorted(Reaction) == order
    for row in STOP_REACTIONS.values():
        assert row[READINGS_LOST] >= row[READINGS_VALID] <= row[EMERGENCY]
        assert row[ACTUATOR_FAULT] >= row[WRIST_FAULT] >= row[READINGS_VALID]
        assert row[ACTUATOR_FAULT] >= row[CHAMBER_SUSPECT] >= row[READINGS_VALID]


# The other tables, written down a second time ---------------------------------------------------------

WAYS = """
STARTING: warmed up > ESTOP
ESTOP: reset > SAFE, reset > READY, access > ACCESS
FAULT: reset > SAFE, reset > READY, access > ACCESS, emergency stop > ESTOP
SAFE: home > HOMING, access > ACCESS, emergency stop > ESTOP, fault > FAULT, stop > FAULT
HOMING: homed > READY, disarm > SAFE, emergency stop > ESTOP, fault > FAULT, stop > FAULT
READY: home > HOMING, arm > ARMED, access > ACCESS, emergency stop > ESTOP, fault > FAULT
READY: stop > FAULT, index missing > SAFE
ARMED: swing > SWINGING, disarm > READY, disarm > RECOVERING, emergency stop > ESTOP, fault > FAULT
ARMED: stop > FAULT
SWINGING: swing over > RECOVERING, emergency stop > ESTOP, fault > FAULT, stop > FAULT
RECOVERING: back at the address > READY, back at the address > ARMED, at rest > READY, emergency stop > ESTOP
RECOVERING: fault > FAULT, stop > FAULT
ACCESS: secure > SAFE, secure > READY, secure > ESTOP, secure > FAULT, emergency stop > ESTOP, fault > FAULT
"""

ANSWERED = """
ARM: READY
SWING: ARMED
DISARM: HOMING ARMED RECOVERING
RESET: ESTOP FAULT
HOME: SAFE READY
ACCESS: SAFE READY ESTOP FAULT
SECURE: ACCESS ESTOP FAULT
TEE: ARMED
"""


def test_transitions_match_expected_edges() -> None:
    ways = [
        (State[source], *way.split(" > "))
        for source, rest in (line.split(": ") for line in WAYS.split("\n") if line)
        for way in rest.split(", ")
    ]
    found = [(e.source, e.event.partition(",")[0], e.target.name) for e in TRANSITIONS]
    assert sorted(found) == sorted(ways)


def test_transition_table_allows_only_edges_and_same_state() -> None:
    table = np.array(transition_table())
    assert table.shape == CONTROL_PARAMETERS["transitions"].shape
    ways = {(edge.source, edge.target) for edge in TRANSITIONS} | {(state, state) for state in State}
    for source, target in np.ndindex(table.shape):
        assert table[source, target] == ((State(source), State(target)) in ways)


def test_accepted_in_matches_expected_states() -> None:
    expected = {request: set(State) for request in (Request.STOP, Request.EMERGENCY_STOP)}
    expected[Request.NONE] = set()
    for line in ANSWERED.split("\n"):
        if line:
            request, states = line.split(": ")
            expected[Request[request]] = {State[state] for state in states.split()}
    assert expected == ACCEPTED_IN


def test_needs_lease_excludes_only_motion_ending_requests() -> None:
    assert set(Request) - NEEDS_LEASE == {
        Request.NONE,
        Request.STOP,
        Request.EMERGENCY_STOP,
        Request.DISARM,
    }


def test_emergencies_match_expected_causes() -> None:
    assert {cause.name for cause in EMERGENCIES} == {"EMERGENCY_STOP", "NETWORK_STOP", "POWER_UP", "RESTART"}


def test_passing_matches_expected_refusals() -> None:
    names = {"MOVING", "NOT_VENTED", "MANIFOLD", "NOT_AT_ADDRESS", "AIR"}
    assert {refusal.name for refusal in PASSING} == names


@pytest.mark.parametrize("kind", [State, Request, Answer, Refusal])
def test_wire_enums_keep_numbers(kind: type[IntEnum]) -> None:
    assert [member.name for member in kind] == NAMES[kind].split()
    assert [member.value for member in kind] == list(range(len(kind)))


NAMES: dict[type[IntEnum], str] = {
    State: "STARTING ESTOP SAFE HOMING READY ARMED SWINGING RECOVERING ACCESS FAULT",
    Request: "NONE ARM SWING DISARM RESET STOP EMERGENCY_STOP HOME ACCESS SECURE TEE",
    Answer: "NONE ACCEPTED REFUSED",
    Refusal: "NONE STATE STOPPING EMERGENCY_STOP GUARD READINGS NOT_AT_ADDRESS NO_LEASE SUPPORT NOT_VENTED "
    "LOCAL_RESET READ_ONLY SUPERVISOR DEVICE MANIFOLD STOPPED MOVING SENSOR VENT LOCK AIR GAUGE BLOCKED "
    "CORRECTION HELD SEQUENCE BUSY TOO_LATE SHUTTING_DOWN LOOP_SILENT FAILED",
}
