"""The stopping table is complete, in order, and the one of the design with its shown departure."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import pytest

from bench.control.envelope import PHASES
from bench.control.step import CONTROL_PARAMETERS
from bench.lifecycle import (
    ACCEPTED_IN,
    CAUSE_TEXT,
    DISOBEYED,
    EMERGENCY,
    LOST,
    STOPPING,
    TRUSTED,
    WRIST_DISOBEYED,
    Cause,
    Phase,
    Reaction,
    Request,
    State,
    accepted_table,
    reaction_table,
)

SLOW = {Phase.HOMING, Phase.HOLD, Phase.BACKSWING, Phase.TOP, Phase.RETURN}
BLOW = {Phase.IMPACT, Phase.FOLLOW_THROUGH}
MOVING = set(Phase) - {Phase.STANDING}


@pytest.mark.parametrize("kind", [Phase, Reaction, Cause])
def test_numbers_are_contiguous_from_zero(kind: type[IntEnum]) -> None:
    assert [member.value for member in kind] == list(range(len(kind)))


def test_requests_are_accepted_where_the_table_says_and_a_stop_everywhere() -> None:
    table = accepted_table()
    assert table.shape == (len(Request), len(State))
    for request, state in np.ndindex(table.shape):
        assert bool(table[request, state]) is (State(state) in ACCEPTED_IN[Request(request)])
    assert table[[Request.STOP, Request.EMERGENCY_STOP]].all()
    assert not table[Request.NONE].any()


def test_every_cause_tells_the_operator_something_of_its_own() -> None:
    assert set(CAUSE_TEXT) == set(Cause)
    assert len(set(CAUSE_TEXT.values())) == len(Cause)
    for text in CAUSE_TEXT.values():
        assert text.strip() == text != ""


def test_causes_of_a_joint_stand_side_by_side() -> None:
    names = ("ENCODER", "RANGE", "SPEED", "FOLLOWING", "STOP_DISTANCE", "AIR", "VELOCITY", "JUMP", "EFFORT")
    for name in names:
        first = Cause[f"SHOULDER_{name}"]
        assert [Cause[f"{joint}_{name}"] - first for joint in ("SHOULDER", "ARM", "WRIST")] == [0, 1, 2]


def test_the_table_names_a_reaction_for_every_phase_and_column() -> None:
    assert list(STOPPING) == list(Phase)
    assert {TRUSTED, LOST, EMERGENCY, DISOBEYED, WRIST_DISOBEYED} == set(range(5))
    for row in STOPPING.values():
        assert len(row) == 5
        assert Reaction.NONE not in row
    table = reaction_table()
    assert table.shape == CONTROL_PARAMETERS["reactions"].shape == (PHASES, 5)
    assert table.dtype == np.uint8
    for phase, column in np.ndindex(table.shape):
        assert Reaction(int(table[phase, column])) is STOPPING[Phase(phase)][column]


def test_standing_is_vented() -> None:
    assert set(STOPPING[Phase.STANDING]) == {Reaction.VENT}


def test_nothing_is_vented_while_it_moves() -> None:
    assert not any(Reaction.VENT in STOPPING[phase] for phase in MOVING)


@pytest.mark.parametrize("phase", sorted(MOVING))
def test_moving_without_readings_is_braked_blindly(phase: Phase) -> None:
    assert STOPPING[phase][LOST] is Reaction.BLIND_BRAKE


@pytest.mark.parametrize("phase", sorted(SLOW | {Phase.DOWNSWING}))
def test_before_the_no_return_instant_a_trusted_stop_brakes(phase: Phase) -> None:
    assert STOPPING[phase][TRUSTED] is STOPPING[phase][EMERGENCY] is Reaction.BRAKE


def test_past_the_no_return_instant_only_an_emergency_stop_brakes() -> None:
    row = STOPPING[Phase.COMMITTED]
    assert (row[TRUSTED], row[EMERGENCY]) == (Reaction.COMPLETE, Reaction.BRAKE)


@pytest.mark.parametrize("phase", sorted(BLOW))
def test_from_the_blow_on_the_swing_brakes_as_planned(phase: Phase) -> None:
    assert {STOPPING[phase][column] for column in (TRUSTED, EMERGENCY, WRIST_DISOBEYED)} == {
        Reaction.COMPLETE
    }


def test_a_shoulder_or_arm_that_does_not_obey_loses_its_air() -> None:
    assert {STOPPING[phase][DISOBEYED] for phase in MOVING} == {Reaction.PASSIVE}


def test_a_wrist_that_does_not_obey_loses_its_air_only_while_it_is_slow() -> None:
    assert {phase for phase in MOVING if STOPPING[phase][WRIST_DISOBEYED] is Reaction.PASSIVE} == SLOW
    fast = MOVING - SLOW - BLOW
    assert {STOPPING[phase][WRIST_DISOBEYED] for phase in fast} == {Reaction.BRAKE}


def test_severity_rises_from_finishing_to_letting_the_air_out() -> None:
    order = [
        Reaction.NONE,
        Reaction.COMPLETE,
        Reaction.BRAKE,
        Reaction.BLIND_BRAKE,
        Reaction.PASSIVE,
        Reaction.VENT,
    ]
    assert sorted(Reaction) == order
    for row in STOPPING.values():
        assert row[LOST] >= row[TRUSTED] <= row[EMERGENCY]
        assert row[DISOBEYED] >= row[WRIST_DISOBEYED] >= row[TRUSTED]
