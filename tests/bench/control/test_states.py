"""The state changes along EDGES only: any other change is a fault in its tick."""

from __future__ import annotations

import numpy as np
import pytest

from bench.control.braking import brake_opening
from bench.lifecycle import EDGES, Cause, Phase, Reaction, Request, State
from tests.bench.control.operating import do, on_the_way, reach
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
def test_a_request_outside_the_matrix_is_a_fault_in_its_tick(
    source: State, request_: Request, target: State
) -> None:
    puppet = reach(source)
    forbid(puppet, source, target)
    do(request_)(puppet)
    assert (puppet.bench, puppet.phase, puppet.reaction) == (State.FAULT, Phase.STANDING, Reaction.VENT)
    assert puppet.control["latest_cause"] == Cause.EXCEPTION
    assert puppet.cause == (Cause.SUPERVISOR if source is State.FAULT else Cause.EXCEPTION)
    assert not puppet.record["supply_enable"][0]


def test_a_swing_outside_the_matrix_does_not_begin_and_the_robot_is_stopped() -> None:
    puppet = reach(State.ARMED)
    forbid(puppet, State.ARMED, State.SWINGING)
    puppet.tick(Request.SWING)
    assert (puppet.bench, puppet.reaction, puppet.cause) == (State.ARMED, Reaction.BRAKE, Cause.EXCEPTION)
    assert not puppet.control["swinging"]
    puppet.run(100)
    assert (puppet.bench, puppet.phase) == (State.FAULT, Phase.STANDING)


def test_a_moving_robot_whose_state_is_wrong_is_braked_in_that_tick() -> None:
    puppet = on_the_way()
    forbid(puppet, State.ARMED, State.RECOVERING)
    puppet.tick(Request.DISARM)
    assert (puppet.bench, puppet.reaction, puppet.cause) == (State.ARMED, Reaction.BRAKE, Cause.EXCEPTION)
    puppet.run(100)
    assert (puppet.bench, puppet.phase) == (State.FAULT, Phase.STANDING)


@pytest.mark.parametrize("state", [len(State), 255])
def test_a_state_that_does_not_exist_is_a_fault(state: int) -> None:
    puppet = reach(State.READY)
    puppet.control["state"] = state
    puppet.give(supervisor_alive=False).tick()
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.SUPERVISOR)
    assert puppet.control["latest_cause"] == Cause.EXCEPTION


def test_an_emergency_stays_one_on_a_way_outside_the_matrix() -> None:
    puppet = reach(State.READY)
    forbid(puppet, State.READY, State.ESTOP)
    puppet.give(emergency_stop_clear=False).tick()
    assert (puppet.bench, puppet.cause) == (State.ESTOP, Cause.EMERGENCY_STOP)
    assert puppet.control["latest_cause"] == Cause.EXCEPTION


def test_the_robot_reaches_ready_again_after_a_forbidden_way() -> None:
    puppet = reach(State.READY)
    forbid(puppet, State.READY, State.ARMED)
    puppet.tick(Request.ARM)
    assert (State.FAULT, State.READY) in {(edge.source, edge.target) for edge in EDGES}
    puppet.run(40)
    puppet.tick(Request.RESET)
    assert (puppet.bench, puppet.cause) == (State.READY, Cause.NONE)


def test_the_braking_law_opposes_motion_and_fades() -> None:
    law = (0.1, 0.01, 1.0)
    assert brake_opening(*law, 2.0, 0.0) == pytest.approx(-0.2)
    assert brake_opening(*law, -2.0, 0.0) == pytest.approx(0.2)
    assert brake_opening(*law, 0.5, 0.0) == pytest.approx(-0.025)
    assert np.isnan(brake_opening(*law, np.nan, 0.0))
