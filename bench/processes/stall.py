"""A stall of the machine behind a stop for lost encoders or a silent supervisor."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.lifecycle import Cause

_ENCODERS = (Cause.SHOULDER_ENCODER, Cause.ARM_ENCODER, Cause.WRIST_ENCODER)
BEFORE = 20
"""Records before the stop in which a stall of the loop explains it: one that begins there ends there."""


def stall_note(
    cycles: np.ndarray[Any, Any], cause: Cause, lost_time: float, period: float, trouble: str = ""
) -> str:
    """Return what explains a stop with `cause` better than a broken encoder; empty if nothing does.

    `trouble` is why the device does not follow commands, if that is known.

    `cycles` (n,) of CYCLE end with the record in which the stop begins. Without a reading for `lost_time` (s)
    an encoder is lost; the loop's `period` is in s. A loop that stands still misses the readings of all
    three, and so does one whose simulated robot or bus does: a cable or its plug loses one.
    """
    if cause is Cause.DEVICE_PASSIVE:
        return trouble
    if cause not in _ENCODERS:
        return ""
    last = cycles[-BEFORE:]
    missing = bool(np.all((last["encoder_valid"][-1] == 0) | (last["encoder_age"][-1] >= lost_time)))
    gap = float(last["measured_step"].max())
    if gap - period >= lost_time / 2:
        return (
            f"the loop stood still for {1e3 * gap:.1f} ms just before, a stall of this machine: run "
            "golfbench doctor; a simulated robot waits for the loop with golfbench run --time paced"
        )
    if trouble:
        return trouble
    if missing:
        return (
            "all three encoders were lost at once: check their bus and supply; with a simulated robot its "
            "process stood still, a stall of this machine: golfbench run --time paced waits for it"
        )
    return ""


def supervisor_note(cause: Cause, gap: float, silence: float) -> str:
    """Return what explains a stop with `cause` after a supervisor's pause of `gap` s; empty if none.

    The loop stops after `silence` (s) without a heartbeat. A supervisor that goes on afterwards was not
    broken: the machine did not run it.
    """
    if cause is not Cause.SUPERVISOR or gap < silence / 2:
        return ""
    return (
        f"the supervisor stood still for {gap:.1f} s, a stall of this machine: run golfbench doctor, and end "
        "what else keeps its processors busy"
    )
