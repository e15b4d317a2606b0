"""Operator actions: a bench is brought into each of its states as in the hall."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from bench.base.lifecycle import (
    Answer,
    Phase,
    Reaction,
    Refusal,
    Request,
    State,
)
from bench.control.settings import SIMULATED, HomingSettings
from tests.bench.control.puppet import ADDRESS, ATMOSPHERE, QUICK, STILL, Puppet

VENT, HOMING, SECURING = 0.02, 0.02, 2.0
"""s."""
TIMES = replace(
    SIMULATED,
    rest_time_vented=0.0,
    rest_time_without_encoders=0.0,
    access_delay=0.0,
    vent_timeout=VENT,
    armed_timeout=1.0,
    hold_between_swings=False,
)
CONTROL = replace(QUICK, precharge_time=0.01)
SHORT = replace(
    STILL,
    **{name: getattr(STILL, name)[-90:] for name in ("angle", "velocity", "valve")},
    begins=(0, 10, 20, 30, 40, 50, 60),
    blind_brake=STILL.blind_brake[-5:],
)
PERMISSIONS = ("lease_held", "support_ready", "supervisor_alive")

Act = Callable[[Puppet], None]


def at_power_up(*, fitted: bool = True, **settings: Any) -> Puppet:
    """Return a bench just switched on, its supervisor alive, everything granted; `fitted` with sensors."""
    puppet = Puppet(
        SHORT,
        CONTROL,
        lifecycle=replace(TIMES, **settings),
        homing=HomingSettings(reference="pose", time=HOMING, stops=False),
        state=State.STARTING,
    )
    for name in PERMISSIONS:
        puppet.control[name] = True
    return puppet.give(chamber_pressure=(ATMOSPHERE,) * 6) if fitted else puppet


def asked(puppet: Puppet, request: int) -> Refusal:
    """Put `request` to the next tick; return why it was refused."""
    answer = puppet.tick(request)
    refusal = Refusal(int(puppet.control["refusal"]))
    assert answer == (Answer.REFUSED if refusal else Answer.ACCEPTED)
    return refusal


def do(request: Request) -> Act:
    """Return the act of asking for `request`."""
    return lambda puppet: void(puppet.tick(request))


def give(**values: Any) -> Act:
    """Return the act of changing inputs without running a tick."""
    return lambda puppet: void(puppet.give(**values))


def void(_: object) -> None: ...


def wait(seconds: float) -> Act:
    return lambda puppet: void(puppet.run(round(seconds / puppet.period)))


def until(puppet: Puppet, *states: State, longest: int = 3000) -> State:
    """Run until the bench is in one of `states`."""
    for _ in range(longest):
        if puppet.bench in states:
            return puppet.bench
        puppet.tick()
    return puppet.bench


def reach(state: State, *, homed: bool = True, fitted: bool = True, **settings: Any) -> Puppet:
    """Return a bench in `state`, brought there the way an operator would; `fitted` with chamber sensors."""
    return deepcopy(_reached(state, homed, fitted, tuple(settings.items())))


@cache
def _reached(state: State, homed: bool, fitted: bool, given: tuple[tuple[str, Any], ...]) -> Puppet:
    settings = dict(given)
    puppet = at_power_up(fitted=fitted, **settings)
    puppet.run(15)
    if state is State.STARTING:
        return puppet
    puppet.control["is_warmed_up"] = True
    puppet.run(round(1000 * puppet.parameters.control["vent_timeout"][0]) + 20)  # vented
    if state is State.ESTOP and not homed:
        return puppet
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    if state is State.SAFE:
        return puppet
    if homed or state is State.HOMING:
        assert asked(puppet, Request.HOME) is Refusal.NONE
        if state is State.HOMING:
            return puppet
        assert until(puppet, State.READY) is State.READY
    if state in {State.ESTOP, State.FAULT}:
        change = "supervisor_alive" if state is State.FAULT else "emergency_stop_clear"
        puppet.give(**{change: False}).tick()
        puppet.give(**{change: True}).tick()
        puppet.run(3)
    elif state is State.ACCESS:
        assert asked(puppet, Request.ACCESS) is Refusal.NONE
        puppet.give(guard_locked=False).tick()
    elif state in {State.ARMED, State.SWINGING, State.RECOVERING}:
        assert asked(puppet, Request.ARM) is Refusal.NONE
        puppet.run(420)
        assert puppet.phase is Phase.HOLD
        if state is not State.ARMED:
            assert asked(puppet, Request.SWING) is Refusal.NONE
            puppet.run(20)
        if state is State.RECOVERING:
            assert until(puppet, State.RECOVERING) is State.RECOVERING
    assert puppet.bench is state
    return puppet


def press(puppet: Puppet) -> None:
    """Press and release the local reset button."""
    for pressed in (False, True, False):
        puppet.give(local_reset=pressed).tick()


def timed(puppet: Puppet, **seconds: float) -> Puppet:
    """Return `puppet` with other times (s) of its lifecycle; its way to its state is not gone again."""
    for name, value in seconds.items():
        puppet.parameters.control[name] = value
    return puppet


def on_the_way(**settings: Any) -> Puppet:
    """Return a bench that moves to its address with air on."""
    puppet = reach(State.READY, **settings)
    for part in range(1, 101):
        puppet.angle = ADDRESS + part / 100 * np.array([0.1, 0.02, -0.1])
        puppet.tick()
    puppet.run(100)
    assert asked(puppet, Request.ARM) is Refusal.NONE
    puppet.run(60)
    assert (puppet.bench, puppet.phase) == (State.ARMED, Phase.RETURN)
    assert puppet.record["supply_enable"][0]
    return puppet


def braking(**settings: Any) -> Puppet:
    """Return a bench that brakes on its way to the address after a disarm request."""
    puppet = on_the_way(**settings)
    puppet.tick(Request.DISARM)
    assert (puppet.bench, puppet.reaction) == (State.RECOVERING, Reaction.BRAKE)
    return puppet


def full(puppet: Puppet) -> None:
    """Let air stay in the chambers."""
    puppet.give(chamber_pressure=(2e5,) * 6).tick()


def lose(puppet: Puppet, joint: int = 1) -> None:
    """Lose an encoder in the next tick, as after five without a sample."""
    puppet.readings["encoder_valid"][0, joint] = 0
    puppet.state.estimator["without_sample"][0, joint] = 1.0
