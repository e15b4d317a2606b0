"""Detection of an unnoticed fault by the next swing, before another ball is struck."""

from __future__ import annotations

from bench.base.lifecycle import REFUSAL_TEXT, Answer, Cause, Refusal, Request, State
from bench.simulation.swing_operator import LockstepEngine

_LOOK = 100
"""Ticks between two looks."""
_TIMEOUT = 90.0
"""Time after which a swing that never comes is given up, s."""


def next_swing(bench: LockstepEngine) -> str:
    """Make `bench` ready for another ball as an operator does, and swing.

    Return the name of the cause that stops it before the ball, or of a request that is refused for good, with
    the reason. "" if the ball is struck.
    """
    plant, latched, refused = bench.plant_state, bench.cause, ""
    plant["emergency_stop_clear"] = plant["guard_closed"] = True
    teed = False
    for _ in range(round(_TIMEOUT / (bench.period * _LOOK))):
        if not teed and bench.resting():
            bench.tee_up(ball=True)
            teed = True
        request = _due(bench)
        if request in (Request.RESET, Request.SECURE):
            plant["local_reset"] = True  # a person presses the button next to the robot
            bench.advance(_LOOK)
            plant["local_reset"] = False
        cycles = bench.advance(_LOOK, request)
        if request and cycles["answer"][0] == Answer.REFUSED:
            why = REFUSAL_TEXT[Refusal(int(cycles["refusal"][0]))]
            refused = f"{Request(request).name.lower()} refused: {why}"
        if bench.cause not in (Cause.NONE, latched):
            return bench.cause.name
        latched = bench.cause
        if teed and bool(plant["struck"][0]):
            return ""
    return refused or "it never swings"


def _due(bench: LockstepEngine) -> int:
    """Return the request that an operator puts next; 0: wait."""
    state = State(int(bench.control["state"][0]))
    if state in (State.FAULT, State.ESTOP):
        return Request.RESET
    if state is State.ACCESS:
        return Request.SECURE
    if state is State.SAFE:
        return Request.HOME
    if state is State.READY and bench.is_vented():
        return Request.ARM
    if state is State.ARMED and bench.resting() and bench.control["tee"][0]:
        return Request.SWING
    return 0
