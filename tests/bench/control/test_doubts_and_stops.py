"""An encoder stays suspect until the chambers are vented, and a stop outlasts commands in flight."""

from __future__ import annotations

from bench.base.lifecycle import Refusal, Request, State
from tests.bench.control.operating import asked, press, reach, timed, until
from tests.bench.control.puppet import ATMOSPHERE


def test_reset_keeps_encoders_suspect_until_vented() -> None:
    puppet = timed(
        reach(State.ARMED), vent_timeout=0.3, rest_time_vented=0.05, rest_time_without_encoders=0.1
    )
    puppet.give(chamber_pressure=(6e5,) * 6)
    puppet.give(encoder_valid=(0, 1, 1)).run(30)
    puppet.give(encoder_valid=1)
    assert until(puppet, State.FAULT) is State.FAULT
    puppet.run(150)
    assert puppet.control["encoders_suspect"]
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    for bar in (5.5, 5.0, 4.5, 4.0, 3.5, 3.0, 2.5, 2.0, 1.5):
        puppet.give(chamber_pressure=(1e5 * bar,) * 6).run(1)
    puppet.give(chamber_pressure=(ATMOSPHERE,) * 6).run(50)
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED
    assert puppet.control["encoders_suspect"]
    puppet.run(55)
    assert not puppet.control["encoders_suspect"]
    assert asked(puppet, Request.ACCESS) is Refusal.NOT_VENTED  # the venting took longer
    puppet.run(200)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


def test_arm_after_reset_ignores_recent_stop() -> None:
    puppet = reach(State.ARMED)
    puppet.step(Request.STOP)
    puppet.run(200)
    assert puppet.bench is State.FAULT
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert asked(puppet, Request.ARM) is Refusal.NONE
