"""Doubts about an encoder last until the air is out, and a stop outlasts what is in flight."""

from __future__ import annotations

import pytest

from bench.control.requests import STOP_HOLDS
from bench.lifecycle import Refusal, Request, State
from tests.bench.control.operating import asked, press, reach
from tests.bench.control.puppet import ATMOSPHERE


def test_a_reset_leaves_a_doubt_about_an_encoder_until_the_air_is_out() -> None:
    puppet = reach(State.ARMED, vent_time=1.2, vented_still=0.05, vented_blind=0.4)
    puppet.give(chamber_pressure=(6e5,) * 6)
    puppet.give(encoder_valid=(0, 1, 1)).run(30)
    puppet.give(encoder_valid=1).run(900)
    assert puppet.bench is State.FAULT
    assert puppet.control["distrusted"]
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    for bar in (5.5, 5.0, 4.5, 4.0, 3.5, 3.0, 2.5, 2.0, 1.5):
        puppet.give(chamber_pressure=(1e5 * bar,) * 6).run(1)
    puppet.give(chamber_pressure=(ATMOSPHERE,) * 6).run(200)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    assert puppet.control["distrusted"]
    puppet.run(220)
    assert not puppet.control["distrusted"]
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED  # the venting took longer
    puppet.run(600)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


@pytest.mark.parametrize("stop", [Request.STOP], ids=lambda request: request.name)
@pytest.mark.parametrize("request_", [Request.ARM, Request.HOME], ids=lambda request: request.name)
def test_what_was_in_flight_when_a_stop_came_is_refused(stop: Request, request_: Request) -> None:
    puppet = reach(State.READY)
    puppet.step(stop)
    assert puppet.bench is State.READY
    for ticks in (0, 10, 1000):
        puppet.run(ticks)
        assert asked(puppet, request_) is Refusal.STOPPED
    puppet.run(round(1000 * STOP_HOLDS))
    assert asked(puppet, request_) is Refusal.NONE


def test_after_a_deliberate_reset_nobody_waits_for_the_stop() -> None:
    puppet = reach(State.ARMED)
    puppet.step(Request.STOP)
    puppet.run(200)
    assert puppet.bench is State.FAULT
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert asked(puppet, Request.ARM) is Refusal.NONE
