"""The state in words: each state, phase and reaction has some, and each cause its action."""

from __future__ import annotations

import json
import re

import pytest

from bench.base.lifecycle import CAUSE_WORDS, MOVING, Phase, Reaction, State
from bench.network.bench_service import CauseStatus
from bench.network.status_words import (
    COMMANDS,
    NO_BALL,
    PHASE_WORDS,
    REACTION_WORDS,
    STATE_WORDS,
    VENTING_WORDS,
)
from bench.supervisor.status import NO_LAUNCH_MONITOR
from bench.web._bench_link import accepted_commands, state_view
from tests.bench.fake_bench_service import FakeDesk


def test_status_words_cover_every_state_phase_and_reaction() -> None:
    assert set(STATE_WORDS) == set(COMMANDS) == set(State)
    assert set(PHASE_WORDS) == set(Phase)
    assert set(REACTION_WORDS) == set(Reaction)


@pytest.mark.parametrize("state", State)
def test_state_view_shows_every_state_and_cause(state: State) -> None:
    status = FakeDesk(state).status() | {"lease": None}
    for cause, (text, action) in CAUSE_WORDS.items():
        status["cause"] = CauseStatus(name=cause.name, text=text, action=action)
        view = state_view(status)
        assert view["cause"]["what"]
        json.dumps(view, allow_nan=False)
    assert not {"stop", "estop"} & set(accepted_commands(state))


def test_state_view_warnings_list_faults_and_read_only() -> None:
    status = FakeDesk().status()
    status["read_only"], status["support_ready"] = True, False
    status["air_faults"], status["drift"] = ["vent 1 does not follow"], ["speed has drifted"]
    warnings = state_view(status)["warnings"]
    assert warnings == [
        "vent 1 does not follow",
        "speed has drifted",
        "device: node 10 (valves and interlocks) has restarted",
        "process recorder is not running: killed by signal 9",
        "nothing is armed without recorder and publisher",
        "read only: the bench observes and sends nothing but safe outputs",
    ]


def test_state_view_absent_launch_monitor_warns() -> None:
    status = FakeDesk().status() | {"launch_monitor": {**NO_LAUNCH_MONITOR, "note": "not listening"}}
    warnings = state_view(status)["warnings"]
    assert "no launch monitor is connected" in warnings
    assert "launch monitor: not listening" in warnings


@pytest.mark.parametrize("state", State)
def test_state_view_unvented_bench_is_not_called_vented(state: State) -> None:
    status = FakeDesk(state).status() | {"vented": False}
    view = state_view(status)
    assert not re.search("(?<!not )vented", view["words"].lower())
    assert view["tone"] != "ready"
    if state not in MOVING | {State.STARTING}:
        assert view["words"] == VENTING_WORDS[state][0] != STATE_WORDS[state][0]
    if state in (State.SAFE, State.READY):
        assert view["words"].startswith("Venting")
        assert state_view(status | {"vented": True})["words"] == STATE_WORDS[state][0]


def test_state_view_ready_tone_requires_ready_state() -> None:
    assert state_view(FakeDesk(State.READY).status())["tone"] == "ready"
    assert state_view(FakeDesk(State.SAFE).status())["tone"] == "rest"


def test_state_view_finished_venting_is_not_shown() -> None:
    status = FakeDesk(State.READY).status() | {"reaction": "VENT"}
    assert state_view(status)["reaction"] == ""
    assert state_view(status | {"vented": False})["reaction"] == "vents"


def test_state_view_missing_ball_is_shown_before_swing() -> None:
    status = FakeDesk(State.ARMED).status()
    assert state_view(status)["next"].startswith(NO_BALL)
    assert NO_BALL not in state_view(status | {"ball_present": True})["next"]


def test_state_view_ready_but_unvented_bench_is_armed_later() -> None:
    status = FakeDesk(State.READY).status() | {"vented": False}
    assert state_view(status)["next"] == "Arm to swing once it is vented."
