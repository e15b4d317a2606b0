"""Reset, homing and arming wait until the robot rests: vents open while it still sways."""

from __future__ import annotations

from math import pi

import pytest

from bench.base.lifecycle import Refusal, Request, State
from tests.bench.control.operating import asked, press, reach
from tests.bench.control.puppet import COUNTS, Puppet

CASES = (
    (State.FAULT, Request.RESET),
    (State.ESTOP, Request.RESET),
    (State.READY, Request.ARM),
    (State.READY, Request.HOME),
)
each_case = pytest.mark.parametrize(
    ("state", "request_"), CASES, ids=[f"{state.name}-{request.name}" for state, request in CASES]
)


def turn(puppet: Puppet, joint: int, speed: float, ticks: int) -> None:
    """Turn `joint` of the standing robot at `speed` (rad/s)."""
    for _ in range(ticks):
        puppet.angle[joint] += speed * puppet.period
        puppet.tick()


@each_case
@pytest.mark.parametrize("joint", range(3))
def test_request_moving_joint_refused(state: State, request_: Request, joint: int) -> None:
    puppet = reach(state)
    turn(puppet, joint, 0.5, 100)
    press(puppet)
    assert asked(puppet, request_) is Refusal.MOVING
    assert puppet.bench is state
    turn(puppet, joint, 0.5, 20)
    puppet.run(20)  # slow, as where a pendulum turns round
    press(puppet)
    assert asked(puppet, request_) is Refusal.MOVING
    puppet.run(100)
    press(puppet)
    assert asked(puppet, request_) is Refusal.NONE


@each_case
def test_request_flickering_count_accepted(state: State, request_: Request) -> None:
    puppet = reach(state)
    at = puppet.angle.copy()
    for k in range(200):
        puppet.angle = at + (k % 2) * 2 * pi / COUNTS
        puppet.tick()
    press(puppet)
    assert asked(puppet, request_) is Refusal.NONE
