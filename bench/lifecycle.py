"""Phases of a swing, causes of a stop, and the one table that says what is done about them.

At 40 m/s the robot carries about 230 J and the air decides what happens, so what is safe depends on the
phase and on what can still be trusted. The compiled control step reads this table (`reaction_table`).
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Phase(IntEnum):
    """Where in a swing the robot is."""

    STANDING = 0
    HOMING = 1
    HOLD = 2
    """At address, chambers charged."""
    BACKSWING = 3
    TOP = 4
    DOWNSWING = 5
    """Can still be stopped short of the ball."""
    COMMITTED = 6
    """Past the profile's no-return instant."""
    IMPACT = 7
    """The profile's impact window."""
    FOLLOW_THROUGH = 8
    RETURN = 9


class Reaction(IntEnum):
    """What is done about a cause, in rising order of severity while the robot moves."""

    NONE = 0
    COMPLETE = 1
    """Finish this swing through its planned braking, then disarm."""
    BRAKE = 2
    """Controlled stop with air on, then VENT at standstill."""
    BLIND_BRAKE = 3
    """Bounded, time-indexed valve pattern of the profile; needs no reading."""
    PASSIVE = 4
    """What the hardware does alone: spools centred, supply shut, throttled vents after a delay."""
    VENT = 5
    """Supply shut and exhausted, chambers exhausted."""


class Cause(IntEnum):
    """Why the envelope stopped the robot; the first cause of a stop is kept."""

    NONE = 0
    EMERGENCY_STOP = 1
    GUARD = 2
    NOT_FINITE = 3
    SHOULDER_ENCODER = 4
    ARM_ENCODER = 5
    WRIST_ENCODER = 6
    TICK_GAP = 7
    SUPPLY_PRESSURE = 8
    SHOULDER_RANGE = 9
    ARM_RANGE = 10
    WRIST_RANGE = 11
    SHOULDER_SPEED = 12
    ARM_SPEED = 13
    WRIST_SPEED = 14
    GROUND = 15
    FRAME = 16
    SHOULDER_FOLLOWING = 17
    ARM_FOLLOWING = 18
    WRIST_FOLLOWING = 19
    SHOULDER_STOP_DISTANCE = 20
    ARM_STOP_DISTANCE = 21
    WRIST_STOP_DISTANCE = 22
    WRIST_LEVER = 23
    OPERATOR_STOP = 24
    EXCEPTION = 25
    ADDRESS_TIMEOUT = 26


CAUSE_TEXT = {
    Cause.NONE: "none",
    Cause.EMERGENCY_STOP: "emergency stop circuit open: release it, then reset",
    Cause.GUARD: "guard open or not locked: close it, then reset",
    Cause.NOT_FINITE: "a value that is not a number reached the envelope: keep the record and report it",
    Cause.SHOULDER_ENCODER: "shoulder encoder R1 without a valid reading: check cable and supply",
    Cause.ARM_ENCODER: "arm encoder R2 without a valid reading: check cable and supply",
    Cause.WRIST_ENCODER: "wrist encoder R3 without a valid reading: check cable and supply",
    Cause.TICK_GAP: "the loop stood still for longer than a swing allows: run `golfbench doctor`",
    Cause.SUPPLY_PRESSURE: "supply pressure below the swing's minimum: check compressor and regulator",
    Cause.SHOULDER_RANGE: "shoulder angle outside its working range",
    Cause.ARM_RANGE: "right-arm rod outside its working range",
    Cause.WRIST_RANGE: "wrist angle outside its working range",
    Cause.SHOULDER_SPEED: "shoulder faster than its limit",
    Cause.ARM_SPEED: "arm faster than its limit",
    Cause.WRIST_SPEED: "wrist faster than its limit",
    Cause.GROUND: "club head nearer to the ground than allowed outside the ball's window",
    Cause.FRAME: "club nearer to the frame than allowed",
    Cause.SHOULDER_FOLLOWING: "shoulder too far from its reference",
    Cause.ARM_FOLLOWING: "arm too far from its reference",
    Cause.WRIST_FOLLOWING: "wrist too far from its reference",
    Cause.SHOULDER_STOP_DISTANCE: "shoulder could no longer stop before its end stop",
    Cause.ARM_STOP_DISTANCE: "right arm could no longer stop before its end stop",
    Cause.WRIST_STOP_DISTANCE: "wrist could no longer stop before its end stop",
    Cause.WRIST_LEVER: "wrist folded so far that its cylinder has no lever",
    Cause.OPERATOR_STOP: "stopped by the operator",
    Cause.EXCEPTION: "the cycle failed in this tick: keep the record and report it",
    Cause.ADDRESS_TIMEOUT: "not at the address in time: check supply, valves and what stands in the way",
}
"""What the operator reads, with the cure where one is known."""

TRUSTED, LOST, EMERGENCY, DISOBEYED = 0, 1, 2, 3
"""Columns of the stopping table: readings trusted, readings lost, emergency stop with readings trusted, an
actuator that does not follow."""

_STANDING = (Reaction.VENT, Reaction.VENT, Reaction.VENT, Reaction.VENT)
_STOPPABLE = (Reaction.BRAKE, Reaction.BLIND_BRAKE, Reaction.BRAKE, Reaction.BRAKE)
_SLOW = (Reaction.BRAKE, Reaction.BLIND_BRAKE, Reaction.BRAKE, Reaction.PASSIVE)

STOPPING: dict[Phase, tuple[Reaction, Reaction, Reaction, Reaction]] = {
    Phase.STANDING: _STANDING,
    Phase.HOMING: _SLOW,
    Phase.HOLD: _SLOW,
    Phase.BACKSWING: _SLOW,
    Phase.TOP: _SLOW,
    Phase.DOWNSWING: _STOPPABLE,
    Phase.COMMITTED: (Reaction.COMPLETE, Reaction.BLIND_BRAKE, Reaction.BRAKE, Reaction.BRAKE),
    Phase.IMPACT: (Reaction.COMPLETE, Reaction.BLIND_BRAKE, Reaction.COMPLETE, Reaction.COMPLETE),
    Phase.FOLLOW_THROUGH: (Reaction.COMPLETE, Reaction.BLIND_BRAKE, Reaction.COMPLETE, Reaction.COMPLETE),
    Phase.RETURN: _SLOW,
}
"""The stopping table: (readings trusted, readings lost, emergency stop, an actuator that does not follow).

A silent bench is PASSIVE by the device itself. In the impact window and the follow-through COMPLETE *is* the
brake as planned. While the robot is slow, an actuator that does not follow may be a stuck valve: only
taking its air away helps, and there is little motion to brake, so the supply is cut (PASSIVE). Departs
from one column 'readings trusted', shown by `golfbench swing check`: BRAKE with air on lets a wrist valve
stuck open at the top put twice its rated energy into the wrist's stop."""


def reaction_table() -> NDArray[np.uint8]:
    """Return the stopping table as an array [phase, column] for compiled code."""
    return np.array([STOPPING[phase] for phase in Phase], dtype=np.uint8)
