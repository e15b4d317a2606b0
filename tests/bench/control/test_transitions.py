"""Every edge of the table of states is taken when its guard holds, and only then, through the real step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

from bench.base.lifecycle import (
    TRANSITIONS,
    Cause,
    Phase,
    Reaction,
    Refusal,
    Request,
    State,
    Transition,
)
from tests.bench.control.operating import (
    HOMING,
    Act,
    asked,
    braking,
    do,
    full,
    give,
    lose,
    on_the_way,
    press,
    reach,
    void,
)
from tests.bench.control.puppet import ADDRESS, Puppet


def latched(source: State, homed: bool) -> Puppet:
    """Return a bench in ESTOP or FAULT whose cause is gone, its button pressed."""
    puppet = reach(source if homed or source is State.ESTOP else State.SAFE, homed=homed, local_reset=True)
    if puppet.bench is not source:
        puppet.give(supervisor_alive=False).tick()
        puppet.give(supervisor_alive=True).tick()
    press(puppet)
    assert (puppet.bench, bool(puppet.control["homed"])) == (source, homed)
    return puppet


def in_access(cause: State | None = None, homed: bool = True) -> Puppet:
    """Return a bench in ACCESS, entered from READY, SAFE, or the state that `cause` has latched."""
    puppet = reach(cause or (State.READY if homed else State.SAFE))
    assert asked(puppet, Request.ACCESS) is Refusal.NONE
    puppet.give(guard_locked=False).tick()
    return puppet


def secure(puppet: Puppet) -> None:
    """Ask for the end of ACCESS; the lock falls if the guard is closed."""
    puppet.tick(Request.SECURE)
    closed = bool(puppet.readings["guard_closed"][0] and puppet.record["guard_lock"][0])
    puppet.give(guard_locked=closed).tick()


def turn_away(puppet: Puppet) -> None:
    """Turn a joint away from where the vented robot hangs."""
    puppet.angle = ADDRESS + [0.2, 0.0, 0.0]
    puppet.give(encoder_valid=0).run(4)
    puppet.give(encoder_valid=1)


class Case(NamedTuple):
    """One way along an edge: the bench before, what happens, s until it is there, and what prevents it."""

    edge: Transition
    before: Callable[[], Puppet]
    event: Act | None
    """None: time alone."""
    settle: float
    but_for: dict[str, Act]


def edge(source: State, event: str, target: State) -> Transition:
    (found,) = (e for e in TRANSITIONS if (e.source, e.event, e.target) == (source, event, target))
    return found


S = State
NO_LEASE: dict[str, Act] = {"lease not held": give(lease_held=False)}
UNCLEAR: dict[str, Act] = {**NO_LEASE, "readings lost": lose}
"""One condition that refuses a request and one found by the step; all: `test_answers.py`."""
UNPRESSED: dict[str, Act] = {"button not pressed": give(reset_pressed=-np.inf)}
PRESSURE: dict[str, Act] = {
    "not vented": give(**{"venting.emptied": False, "vented": False, "venting.start": np.inf})
}
CLOSED: dict[str, Act] = {"guard open": give(guard_closed=False), **NO_LEASE}
AWAY: dict[str, Act] = {"not at the address": lambda puppet: puppet.shift(0, 0.02)}
BRAKED, SWUNG = 0.1, 2.0
LEFT: dict[str, Act] = {
    "disarmed": do(Request.DISARM),
    "lease lost": give(lease_held=False),
    "recorder lost": give(support_ready=False),
}


def regained(name: str) -> Act:
    """Return the act of losing a permission for a tick, and getting it back."""

    def act(puppet: Puppet) -> None:
        puppet.give(**{name: False}).tick()
        puppet.give(**{name: True}).tick()

    return act


def cases() -> list[Case]:
    """Return all ways along all edges."""
    made = [
        Case(
            edge(S.STARTING, "warmed up", S.ESTOP), lambda: reach(S.STARTING), give(is_warmed_up=True), 0, {}
        ),
        Case(
            edge(S.HOMING, "homed", S.READY),
            lambda: reach(S.HOMING),
            None,
            2 * HOMING,
            {"another pose": turn_away, "index lost": give(encoder_indexed=(1, 0, 1))},
        ),
        Case(
            edge(S.READY, "index missing", S.SAFE),
            lambda: reach(S.READY).give(encoders_seen_valid=False),
            give(encoder_indexed=0),
            0,
            {"a reading trusted before": give(encoders_seen_valid=True)},
        ),
        Case(
            edge(S.READY, "arm", S.ARMED),
            lambda: reach(S.READY),
            do(Request.ARM),
            0,
            UNCLEAR,
        ),
        Case(
            edge(S.ARMED, "swing", S.SWINGING),
            lambda: reach(S.ARMED),
            do(Request.SWING),
            0,
            UNCLEAR | AWAY,
        ),
        Case(edge(S.SWINGING, "swing over", S.RECOVERING), lambda: reach(S.SWINGING), None, 0.1, {}),
        Case(
            edge(S.RECOVERING, "back at the address", S.READY), lambda: reach(S.RECOVERING), None, SWUNG, {}
        ),
        Case(
            edge(S.RECOVERING, "back at the address", S.ARMED),
            lambda: reach(S.RECOVERING, hold_between_swings=True),
            None,
            SWUNG,
            LEFT
            | {
                "lease regained": regained("lease_held"),
                "recorder regained": regained("support_ready"),
                "no series": lambda puppet: void(
                    puppet.parameters.control.__setitem__("hold_between_swings", False)
                ),
            },
        ),
        Case(edge(S.RECOVERING, "at rest", S.READY), braking, None, BRAKED, {}),
        Case(
            edge(S.FAULT, "emergency stop", S.ESTOP),
            lambda: reach(S.FAULT),
            do(Request.EMERGENCY_STOP),
            0,
            {},
        ),
        *(
            Case(
                edge(S.ARMED, "disarm, time-out, lease or recorder lost", S.READY),
                lambda: reach(S.ARMED),
                event,
                settle,
                {},
            )
            for event, settle in (*((event, 0.0) for event in LEFT.values()), (None, 1.0))
        ),
        *(
            Case(
                edge(S.ARMED, "disarm, lease or recorder lost", S.RECOVERING),
                on_the_way,
                event,
                0,
                {"no air yet": give(air=False)},
            )
            for event in LEFT.values()
        ),
        *(
            Case(edge(S.HOMING, "disarm, or lease lost", S.SAFE), lambda: reach(S.HOMING), LEFT[name], 0, {})
            for name in ("disarmed", "lease lost")
        ),
    ]
    for source in (S.ESTOP, S.FAULT):
        for homed in (False, True):
            made.append(
                Case(
                    edge(source, "reset", S.READY if homed else S.SAFE),
                    partial(latched, source, homed),
                    do(Request.RESET),
                    0,
                    UNCLEAR | UNPRESSED | {"chambers not emptied": full},
                )
            )
        made.append(Case(edge(S.ACCESS, "secure", source), partial(in_access, source), secure, 0, CLOSED))
    for homed, source in ((False, S.SAFE), (True, S.READY)):
        made.append(
            Case(
                edge(source, "home", S.HOMING),
                partial(reach, source),
                do(Request.HOME),
                0,
                UNCLEAR | PRESSURE,
            )
        )
        made.append(
            Case(edge(S.ACCESS, "secure", source), partial(in_access, homed=homed), secure, 0, CLOSED)
        )
    made += [
        Case(
            edge(source, "access", S.ACCESS),
            partial(reach, source),
            do(Request.ACCESS),
            0,
            NO_LEASE | PRESSURE,
        )
        for source in (S.SAFE, S.READY, S.ESTOP, S.FAULT)
    ]
    for name, target, events in (
        ("emergency stop", S.ESTOP, (give(emergency_stop_clear=False), do(Request.EMERGENCY_STOP))),
        ("fault", S.FAULT, (give(supervisor_alive=False), give(device_operational=False))),
        ("stop", S.FAULT, (do(Request.STOP),)),
    ):
        made += [
            Case(e, partial(reach, e.source), event, 1.6, {})
            for e in TRANSITIONS
            for event in events
            if (e.event, e.target) == (name, target) and e.source is not S.FAULT
        ]
    return made


CASES = cases()
NAMES = [f"{i}-{c.edge.source.name}-{c.edge.event}-{c.edge.target.name}" for i, c in enumerate(CASES)]
each_case = pytest.mark.parametrize("case", CASES, ids=NAMES)


def test_cases_cover_all_transitions() -> None:
    assert {case.edge for case in CASES} == set(TRANSITIONS)


def follow(case: Case, puppet: Puppet) -> State:
    """Let the event of `case` happen; return the first other state within its time."""
    if case.event:
        case.event(puppet)
    if puppet.bench is case.edge.source:
        puppet.tick()
    for _ in range(round(case.settle / puppet.period)):
        if puppet.bench is not case.edge.source:
            break
        puppet.tick()
    return puppet.bench


@each_case
def test_transition_with_guard_reaches_target(case: Case) -> None:
    assert follow(case, case.before()) is case.edge.target


@pytest.mark.parametrize(
    ("case", "prevent"),
    [
        pytest.param(case, act, id=f"{name}-{why}")
        for case, name in zip(CASES, NAMES, strict=True)
        for why, act in case.but_for.items()
    ],
)
def test_transition_without_guard_does_not_happen(case: Case, prevent: Act) -> None:
    puppet = case.before()
    prevent(puppet)
    assert follow(case, puppet) is not case.edge.target


@each_case
def test_transition_without_event_does_not_happen(case: Case) -> None:
    puppet = case.before()
    if case.event is not None:
        puppet.run(10)
        assert puppet.bench is case.edge.source


@pytest.mark.parametrize("event", ["emergency stop", "fault", "stop"])
@pytest.mark.parametrize("source", [S.ARMED, S.SWINGING, S.RECOVERING], ids=lambda state: state.name)
def test_transition_in_motion_brakes_before_latching(source: State, event: str) -> None:
    case = next(case for case in CASES if (case.edge.source, case.edge.event) == (source, event))
    puppet = reach(source) if source is not S.ARMED else on_the_way()
    assert case.event is not None
    case.event(puppet)
    puppet.tick()
    assert (puppet.bench, puppet.reaction) == (source, Reaction.BRAKE)
    assert follow(case, puppet) is case.edge.target
    assert puppet.phase is Phase.STANDING


def test_secure_guard_not_locked_in_time_faults() -> None:
    puppet = in_access()
    puppet.tick(Request.SECURE)
    puppet.run(1990)
    assert puppet.bench is State.ACCESS
    puppet.run(20)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.GUARD)


def test_stop_in_access_keeps_state() -> None:
    puppet = reach(S.ACCESS)
    assert asked(puppet, Request.STOP) is Refusal.NONE
    assert (puppet.bench, puppet.cause) == (S.ACCESS, Cause.NONE)


@pytest.mark.parametrize("source", [S.SAFE, S.READY])
def test_stop_at_rest_latches_until_reset(source: State) -> None:
    puppet = reach(source)
    assert asked(puppet, Request.STOP) is Refusal.NONE
    assert (puppet.bench, puppet.cause) == (S.FAULT, Cause.OPERATOR_STOP)
    puppet.run(2000)
    assert asked(puppet, Request.ARM) is Refusal.STATE
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert puppet.bench is source


# A change that the table forbids ----------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("before", "request_", "target"),
    [
        (partial(reach, State.ARMED), Request.SWING, State.SWINGING),
        (on_the_way, Request.DISARM, State.RECOVERING),
    ],
)
def test_forbidden_transition_from_armed_brakes_in_same_tick(
    before: Callable[[], Puppet], request_: Request, target: State
) -> None:
    puppet = before()
    forbid(puppet, State.ARMED, target)
    puppet.tick(request_)
    assert (puppet.bench, puppet.reaction, puppet.cause) == (State.ARMED, Reaction.BRAKE, Cause.EXCEPTION)
    assert not puppet.control["swinging"]
    puppet.run(100)
    assert (puppet.bench, puppet.phase) == (State.FAULT, Phase.STANDING)


def test_reset_after_forbidden_transition_returns_to_ready() -> None:
    puppet = reach(State.READY)
    forbid(puppet, State.READY, State.ARMED)
    puppet.tick(Request.ARM)
    assert (State.FAULT, State.READY) in {(edge.source, edge.target) for edge in TRANSITIONS}
    puppet.run(40)
    puppet.tick(Request.RESET)
    assert (puppet.bench, puppet.cause) == (State.READY, Cause.NONE)
