"""States of the bench, phases of a swing, causes of a stop, and the tables of transitions and reactions.

`TRANSITIONS` has the transitions between states, `STOP_REACTIONS` the reaction to a cause. At 40 m/s the
robot carries about 230 J and compressed air governs its motion. So the safe reaction depends on the phase and
on the sensors and valves that still work. The compiled control step reads them as `transition_table` and
`reaction_table`.
"""

from __future__ import annotations

from enum import IntEnum, StrEnum
from typing import NamedTuple


class State(IntEnum):
    """State of the bench. The robot moves in HOMING, ARMED, SWINGING and RECOVERING only."""

    STARTING = 0
    ESTOP = 1
    """Latched; also after power-up and restart."""
    SAFE = 2
    """Vented, not homed."""
    HOMING = 3
    READY = 4
    """Vented, homed."""
    ARMED = 5
    """Guard locked, warning given, air on; at the address or on the way to it. Times out."""
    SWINGING = 6
    RECOVERING = 7
    """On the way back to the address after a swing, or braking on the way to READY."""
    ACCESS = 8
    """Vented and guard unlocked: clubs and balls are changed here."""
    FAULT = 9
    """Latched."""


MOVING = frozenset({State.HOMING, State.ARMED, State.SWINGING, State.RECOVERING})
"""States in which the robot moves or may move."""
LATCHED = frozenset({State.ESTOP, State.FAULT})
"""States that only a reset ends."""


class Request(IntEnum):
    """Requests to the control step; each is answered in its tick."""

    NONE = 0
    ARM = 1
    SWING = 2
    DISARM = 3
    RESET = 4
    STOP = 5
    EMERGENCY_STOP = 6
    """Stop over the network: a convenience, not a safety function."""
    HOME = 7
    ACCESS = 8
    SECURE = 9
    """End ACCESS: lock the guard."""
    TEE = 10
    """Raise the next ball."""


class Answer(IntEnum):
    """Answer to a request."""

    NONE = 0
    ACCEPTED = 1
    REFUSED = 2


class Block(StrEnum):
    """Reason that blocks arming until the configuration, a calibration or the profile changes."""

    CONFIGURATION = "configuration"
    """Configuration and calibrations contradict each other."""
    SWING = "swing"
    """Profile, club, ball and site do not fit the calibrated machine."""
    CALIBRATION_MISSING = "calibration_missing"
    CALIBRATION_EXPIRED = "calibration_expired"
    INPUTS = "inputs"
    """Check of a machine's inputs missing, expired, of other settings or with findings: blocks homing too."""
    CALIBRATION_AHEAD = "calibration_ahead"
    """Calibration dated later than the clock."""
    CALIBRATION_NOT_LOADED = "calibration_not_loaded"
    """Calibration newer than the one that the loop was started with."""
    UNREADABLE = "unreadable"
    """Calibrations that cannot be read."""


Words = tuple[str, str]
"""Fact and action, for the operator; the action is empty where none is known."""


class Refusal(IntEnum):
    """Why a request was refused."""

    NONE = 0
    STATE = 1
    STOPPING = 2
    EMERGENCY_STOP = 3
    GUARD = 4
    READINGS = 5
    NOT_AT_ADDRESS = 6
    NO_LEASE = 7
    SUPPORT = 8
    NOT_VENTED = 9
    LOCAL_RESET = 10
    READ_ONLY = 11
    SUPERVISOR = 12
    DEVICE = 13
    MANIFOLD = 14
    STOPPED = 15
    MOVING = 16
    SENSOR = 17
    VENT = 18
    LOCK = 19
    AIR = 20
    GAUGE = 21
    # By the supervisor, before the control step is asked:
    BLOCKED = 22
    """Refusal that a reason of `Block` explains."""
    CORRECTION = 23
    HELD = 24
    SEQUENCE = 25
    BUSY = 26
    TOO_LATE = 27
    SHUTTING_DOWN = 28
    LOOP_SILENT = 29
    FAILED = 30


REFUSAL_WORDS: dict[Refusal, Words] = {
    Refusal.NONE: ("not refused", ""),
    Refusal.STATE: ("not possible in this state", ""),
    Refusal.STOPPING: ("a stop is under way", "wait for standstill"),
    Refusal.EMERGENCY_STOP: ("the emergency stop circuit is open", "release it and reset the safety relay"),
    Refusal.GUARD: ("the guard is open or not locked", "close it (after an access: golfbench access --end)"),
    Refusal.READINGS: ("an encoder yields no valid readings", "check cables and supply voltage"),
    Refusal.NOT_AT_ADDRESS: ("the robot does not rest at its address yet", "wait, then retry"),
    Refusal.AIR: ("the chambers are not at their planned pressures yet", "wait, then retry"),
    Refusal.NO_LEASE: ("no valid lease", "take it (golfbench lease take), then retry"),
    Refusal.SUPPORT: ("the recorder or the publisher is not running", "nothing is armed without a record"),
    Refusal.NOT_VENTED: ("the chambers are not verified empty yet", "wait, then retry"),
    Refusal.LOCAL_RESET: ("the local reset at the guard was not pressed", "press it, then retry"),
    Refusal.READ_ONLY: ("this bench was started to observe only", ""),
    Refusal.SUPERVISOR: ("no heartbeat from the supervisor", "read the log, then retry"),
    Refusal.DEVICE: ("the device went passive", "reset first"),
    Refusal.SENSOR: ("a fitted pressure sensor has no plausible value", "see `golfbench status`"),
    Refusal.VENT: (
        "a vent, the shut-off valve or a spool does not follow its command",
        "see `golfbench status`",
    ),
    Refusal.LOCK: (
        "the guard read locked while released or open",
        "check lock and switches, release it again",
    ),
    Refusal.STOPPED: ("a stop was requested a moment ago", "wait two seconds, then retry"),
    Refusal.MOVING: ("a joint still moves", "wait until the robot rests, then retry"),
    Refusal.GAUGE: (
        "no sensor verifies that the chambers are empty",
        "lock the supply; once both gauges show 0, press the local reset, then retry",
    ),
    Refusal.MANIFOLD: (
        "the supply manifold still holds pressure",
        "wait, or empty it by its hand valve; at 0 on its gauge check its sensor",
    ),
    Refusal.BLOCKED: ("arming is blocked", "remove what blocks it"),
    Refusal.CORRECTION: ("the correction does not fit this bench", "learn again"),
    Refusal.HELD: ("another holder has the lease", "wait, or have the holder release it"),
    Refusal.SEQUENCE: ("the command was repeated or out of order", "check the state, then retry"),
    Refusal.BUSY: ("too many messages wait; this one was discarded", "retry"),
    Refusal.TOO_LATE: ("the command waited too long and was not done", "retry"),
    Refusal.SHUTTING_DOWN: ("the bench is shutting down", "retry after its restart"),
    Refusal.LOOP_SILENT: ("the loop does not answer", "press the emergency stop, read the log"),
    Refusal.FAILED: ("the bench could not do it", "read its log, and report it"),
}
"""Default fact and action of each refusal; some refusals report the value found instead."""


def in_one(words: Words) -> str:
    """Return fact and action in one line."""
    return ": ".join(filter(None, words))


REFUSAL_TEXT = {refusal: in_one(words) for refusal, words in REFUSAL_WORDS.items()}

PASSING = frozenset(
    {Refusal.MOVING, Refusal.NOT_VENTED, Refusal.MANIFOLD, Refusal.NOT_AT_ADDRESS, Refusal.AIR}
)
"""Refusals that clear without action: the robot sways or comes to rest, chambers vent or fill. Refusals after
a stop are not among them: the bench does not execute a request from before a stop."""


class Phase(IntEnum):
    """Where in a swing the robot is."""

    STANDING = 0
    HOMING = 1
    HOLD = 2
    """Hold of the address, chambers charged."""
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
    """Reaction to a cause, in rising order of severity while the robot moves."""

    NONE = 0
    COMPLETE = 1
    """Finish this swing through its planned braking, then latch the cause at standstill."""
    BRAKE = 2
    """Controlled stop with air on, then VENT at standstill."""
    BLIND_BRAKE = 3
    """Bounded, time-indexed valve pattern of the profile, open loop: it uses no sensor."""
    PASSIVE = 4
    """Reaction of the hardware alone: spools centred, supply shut, throttled vents after a delay."""
    VENT = 5
    """Supply shut and exhausted, chambers exhausted."""


class Cause(IntEnum):
    """Cause of a stop or of disarming.

    The first cause of a stop is kept, unless an emergency or trapped pressure is found on top. LEASE,
    ARMED_TIME and SUPPORT disarm and latch nothing; the supervisor names them until the robot moves again.
    """

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
    NETWORK_STOP = 27
    POWER_UP = 28
    RESTART = 29
    SUPERVISOR = 30
    HOMING_FAILED = 31
    NOT_VENTED = 32
    DEVICE_PASSIVE = 33
    SHOULDER_AIR = 34
    ARM_AIR = 35
    WRIST_AIR = 36
    SHOULDER_VELOCITY = 37
    ARM_VELOCITY = 38
    WRIST_VELOCITY = 39
    SHOULDER_JUMP = 40
    ARM_JUMP = 41
    WRIST_JUMP = 42
    SHOULDER_EFFORT = 43
    ARM_EFFORT = 44
    WRIST_EFFORT = 45
    SHOULDER_FLOW = 46
    ARM_FLOW = 47
    WRIST_FLOW = 48
    SHOULDER_SENSOR = 49
    ARM_SENSOR = 50
    WRIST_SENSOR = 51
    MANIFOLD = 52
    SUPPLY_SENSOR = 53
    SHOULDER_A_SENSOR = 54
    SHOULDER_B_SENSOR = 55
    ARM_A_SENSOR = 56
    ARM_B_SENSOR = 57
    WRIST_A_SENSOR = 58
    WRIST_B_SENSOR = 59
    VENT_1 = 60
    VENT_2 = 61
    SHOULDER_ZERO = 62
    ARM_ZERO = 63
    WRIST_ZERO = 64
    GUARD_LOCK = 65
    SUPPLY_VALVE = 66
    SUPPLY_DECAY = 67
    SHOULDER_INDEX = 68
    ARM_INDEX = 69
    WRIST_INDEX = 70
    SHOULDER_A_AIR = 71
    SHOULDER_B_AIR = 72
    ARM_A_AIR = 73
    ARM_B_AIR = 74
    WRIST_A_AIR = 75
    WRIST_B_AIR = 76
    SHUT_OFF = 77
    SHOULDER_A_EXHAUST = 78
    SHOULDER_B_EXHAUST = 79
    ARM_A_EXHAUST = 80
    ARM_B_EXHAUST = 81
    WRIST_A_EXHAUST = 82
    WRIST_B_EXHAUST = 83
    LEASE = 84
    ARMED_TIME = 85
    SUPPORT = 86
    SHOULDER_SPOOL = 87
    ARM_SPOOL = 88
    WRIST_SPOOL = 89


_JOINTS = (("shoulder", "R1"), ("right arm", "R2"), ("wrist", "R3"))
_WORN_VALVE = "check valve and sensors; if nothing is broken, the valve is worn: see golfbench wear"
_WORN_OR_SENSOR = (
    "check its sensor: vented, it shows the atmosphere in golfbench status; if it does, the valve is worn: "
    "see golfbench wear"
)


def _each_joint(first: Cause, fact: str, action: str = "") -> dict[Cause, Words]:
    """Return the words of three causes from `first` on, of each {joint} with its {encoder}."""
    return {
        Cause(first + k): (fact.format(joint=joint, encoder=encoder), action.format(encoder=encoder))
        for k, (joint, encoder) in enumerate(_JOINTS)
    }


def _each_chamber(first: Cause, fact: str, action: str) -> dict[Cause, Words]:
    """Return the words of six causes from `first` on, of each {chamber}."""
    chambers = (f"{joint} chamber {side}" for joint, _ in _JOINTS for side in "AB")
    return {Cause(first + k): (fact.format(chamber=chamber), action) for k, chamber in enumerate(chambers)}


CAUSE_WORDS: dict[Cause, Words] = {
    Cause.NONE: ("none", ""),
    Cause.EMERGENCY_STOP: ("emergency stop circuit open", "release it, reset the safety relay, then reset"),
    Cause.GUARD: (
        "guard open or not locked",
        "check that no one is inside, close it, check its lock, then reset",
    ),
    Cause.NOT_FINITE: ("a NaN or infinite value reached the envelope", "keep the record and report it"),
    **_each_joint(
        Cause.SHOULDER_ENCODER, "{joint} encoder {encoder} without a valid reading", "check cable and voltage"
    ),
    Cause.TICK_GAP: ("the loop paused for longer than a swing allows", "run `golfbench doctor`"),
    Cause.SUPPLY_PRESSURE: ("supply pressure outside the range for swings", "check compressor and regulator"),
    **_each_joint(Cause.SHOULDER_RANGE, "{joint} outside its working range"),
    **_each_joint(Cause.SHOULDER_SPEED, "{joint} faster than its limit"),
    Cause.GROUND: ("club head too near to the ground", "check the club, reset, then home, which lifts it"),
    Cause.FRAME: ("club nearer to the frame than allowed", ""),
    **_each_joint(Cause.SHOULDER_FOLLOWING, "{joint} too far from its reference"),
    **_each_joint(Cause.SHOULDER_STOP_DISTANCE, "{joint} could no longer stop before its end stop"),
    Cause.WRIST_LEVER: ("wrist folded so far that its cylinder has no lever", ""),
    Cause.OPERATOR_STOP: ("stopped by the operator", ""),
    Cause.EXCEPTION: ("internal fault of the cycle in this tick", "keep the record and report it"),
    Cause.ADDRESS_TIMEOUT: ("not at the address in time", "check supply, valves and obstacles"),
    Cause.NETWORK_STOP: ("emergency stop requested over the network", "find the reason, then reset"),
    Cause.POWER_UP: ("the bench was switched on", "reset to begin"),
    Cause.RESTART: ("the previous shutdown was unclean", "read the record of the last stop, then reset"),
    Cause.SUPERVISOR: ("no heartbeat from the supervisor", "read the log, then reset"),
    Cause.HOMING_FAILED: (
        "encoders and mechanical reference do not agree, or no index was found",
        "calibrate",
    ),
    Cause.NOT_VENTED: (
        "the chambers did not empty in time",
        "keep away from the robot; press the emergency stop, then open the hand valves",
    ),
    Cause.DEVICE_PASSIVE: (
        "the device went passive after a time-out of its commands",
        "read its fault in golfbench status, then reset",
    ),
    **_each_joint(
        Cause.SHOULDER_AIR,
        "{joint}'s chamber pressures do not follow the valve command",
        "check valve, supply and sensors",
    ),
    **_each_joint(
        Cause.SHOULDER_VELOCITY,
        "{joint} velocity deviates from the model",
        "check valve, supply and encoder {encoder}",
    ),
    **_each_joint(
        Cause.SHOULDER_JUMP,
        "encoder {encoder} ({joint}) reports an impossible jump",
        "check cable and mount",
    ),
    **_each_joint(
        Cause.SHOULDER_EFFORT,
        "{joint}'s motion and chamber pressures disagree",
        "check encoder {encoder}, club, pressure sensors",
    ),
    **_each_joint(Cause.SHOULDER_FLOW, "{joint} valve's flow deviates from its command", _WORN_VALVE),
    **_each_joint(
        Cause.SHOULDER_SENSOR, "one {joint} chamber alone deviates from the model", _WORN_OR_SENSOR
    ),
    Cause.MANIFOLD: (
        "the manifold holds pressure with the supply shut",
        "keep away; lock the supply, empty the manifold by its hand valve",
    ),
    Cause.SUPPLY_SENSOR: (
        "supply sensor without a plausible value",
        "check cable and sensor at the manifold",
    ),
    **_each_chamber(
        Cause.SHOULDER_A_SENSOR, "sensor of {chamber} without a plausible value", "check cable and sensor"
    ),
    Cause.VENT_1: ("vent 1 does not follow its command", "check valve and position switch"),
    Cause.VENT_2: ("vent 2 does not follow its command", "check valve and position switch"),
    **_each_joint(
        Cause.SHOULDER_ZERO,
        "{joint}'s end stop found at a different angle than encoder {encoder} reports",
        "check its coupling and zero",
    ),
    Cause.GUARD_LOCK: ("guard reads locked while it is released or open", "check lock and switch"),
    Cause.SUPPLY_VALVE: ("the manifold empties too slowly", "check supply valve, dump valve and its sensor"),
    Cause.SUPPLY_DECAY: ("supply sensor shows less than the manifold can hold", "check cable and sensor"),
    **_each_joint(
        Cause.SHOULDER_INDEX,
        "{joint} encoder {encoder} had lost counts at its index",
        "check its cable, home again",
    ),
    **_each_chamber(
        Cause.SHOULDER_A_AIR, "{chamber} did not reach its planned pressure in time", "check supply and leaks"
    ),
    Cause.SHUT_OFF: ("shut-off valve does not follow its command", "check valve and position switch"),
    **_each_chamber(
        Cause.SHOULDER_A_EXHAUST,
        "{chamber} vents too slowly",
        "lock the supply, open its joint's hand valves; check silencer, hose and sensor's zero",
    ),
    Cause.LEASE: ("disarmed, as the lease lapsed or was released", "take it, then arm"),
    Cause.ARMED_TIME: ("disarmed, as it was armed for longer than allowed", "arm again"),
    Cause.SUPPORT: ("disarmed, as recorder or publisher stopped", "wait until both run, then arm"),
    **_each_joint(
        Cause.SHOULDER_SPOOL,
        "{joint} valve's spool deviates from its command",
        "check valve, supply of its electronics and the feedback's cable",
    ),
}

CAUSE_TEXT = {cause: in_one(words) for cause, words in CAUSE_WORDS.items()}
"""Text for the operator in one line."""

EMERGENCIES = frozenset({Cause.EMERGENCY_STOP, Cause.NETWORK_STOP, Cause.POWER_UP, Cause.RESTART})
"""Causes that latch ESTOP; every other one latches FAULT."""


class Transition(NamedTuple):
    """One transition between states."""

    source: State
    event: str
    target: State
    guard: str = ""
    effect: str = ""


_S = State
_CLEAR = "interlocks closed, readings trusted, lease held, supervisor alive"
_GONE = f"cause gone, {_CLEAR}, local reset pressed after the stop"
_STILL = "for the absolute method chambers proven empty"
_ACCESSIBLE = "chambers and manifold proven empty, emergency stop circuit closed, lease held"
_LEFT = "guard closed, then local reset pressed"
_MOVES = (_S.HOMING, _S.ARMED, _S.SWINGING, _S.RECOVERING)
_LATCHES = (_S.SAFE, _S.HOMING, _S.READY, _S.ARMED, _S.SWINGING, _S.RECOVERING, _S.ACCESS)

TRANSITIONS = (
    Transition(_S.STARTING, "warmed up", _S.ESTOP, "", "cause POWER_UP or RESTART"),
    Transition(_S.ESTOP, "reset", _S.SAFE, f"{_GONE}; not homed", "never moves"),
    Transition(_S.ESTOP, "reset", _S.READY, f"{_GONE}; homed", "never moves"),
    Transition(_S.FAULT, "reset", _S.SAFE, f"{_GONE}; not homed", "never moves"),
    Transition(_S.FAULT, "reset", _S.READY, f"{_GONE}; homed", "never moves"),
    Transition(_S.READY, "index missing", _S.SAFE, "no reading trusted since the start"),
    Transition(_S.SAFE, "home", _S.HOMING, f"{_CLEAR}, {_STILL}", "the only motion allowed until homed"),
    Transition(_S.READY, "home", _S.HOMING, f"{_CLEAR}, {_STILL}"),
    Transition(_S.HOMING, "homed", _S.READY, "angles plausible", "vented"),
    Transition(_S.HOMING, "disarm, or lease lost", _S.SAFE, "", "brake, vent"),
    Transition(
        _S.READY,
        "arm",
        _S.ARMED,
        f"no stop a moment ago, {_CLEAR}, recorder alive, no pressure shown in a chamber",
        "warn, charge, go to address",
    ),
    Transition(_S.ARMED, "swing", _S.SWINGING, f"rests at the address, {_CLEAR}, recorder alive"),
    Transition(_S.ARMED, "disarm, time-out, lease or recorder lost", _S.READY, "at rest", "vent"),
    Transition(_S.ARMED, "disarm, lease or recorder lost", _S.RECOVERING, "on the way to address", "brake"),
    Transition(_S.SWINGING, "swing over", _S.RECOVERING, "", "return to the address"),
    Transition(_S.RECOVERING, "back at the address", _S.READY, "", "vent"),
    Transition(
        _S.RECOVERING, "back at the address", _S.ARMED, "series requested, lease and recorder never lost"
    ),
    Transition(_S.RECOVERING, "at rest", _S.READY, "was braking", "vent"),
    Transition(_S.SAFE, "access", _S.ACCESS, _ACCESSIBLE, "unlock the guard"),
    Transition(_S.READY, "access", _S.ACCESS, _ACCESSIBLE, "unlock the guard"),
    Transition(_S.ACCESS, "secure", _S.SAFE, f"{_LEFT}; not homed", "lock the guard"),
    Transition(_S.ACCESS, "secure", _S.READY, f"{_LEFT}; homed", "lock the guard"),
    Transition(_S.ESTOP, "access", _S.ACCESS, _ACCESSIBLE, "unlock the guard"),
    Transition(_S.FAULT, "access", _S.ACCESS, _ACCESSIBLE, "unlock the guard"),
    Transition(_S.ACCESS, "secure", _S.ESTOP, f"{_LEFT}; its cause still latched", "lock the guard"),
    Transition(_S.ACCESS, "secure", _S.FAULT, f"{_LEFT}; its cause still latched", "lock the guard"),
    *(
        Transition(s, "emergency stop", _S.ESTOP, "at standstill", "stopping table, then vent")
        for s in _LATCHES
    ),
    *(Transition(s, "fault", _S.FAULT, "at standstill", "stopping table, then vent") for s in _LATCHES),
    *(
        Transition(s, "stop", _S.FAULT, "at standstill", "stopping table, then vent")
        for s in (_S.SAFE, _S.READY, *_MOVES)
    ),
    Transition(_S.FAULT, "emergency stop", _S.ESTOP),
)
"""All transitions between states; the control step takes no other. Requests have the names in `Request`."""

ACCEPTED_IN: dict[Request, frozenset[State]] = {
    Request.NONE: frozenset(),
    Request.ARM: frozenset({_S.READY}),
    Request.SWING: frozenset({_S.ARMED}),
    Request.DISARM: frozenset({_S.HOMING, _S.ARMED, _S.RECOVERING}),
    Request.RESET: frozenset({_S.ESTOP, _S.FAULT}),
    Request.STOP: frozenset(State),
    Request.EMERGENCY_STOP: frozenset(State),
    Request.HOME: frozenset({_S.SAFE, _S.READY}),
    Request.ACCESS: frozenset({_S.SAFE, _S.READY, _S.ESTOP, _S.FAULT}),
    Request.SECURE: frozenset({_S.ACCESS, _S.ESTOP, _S.FAULT}),
    Request.TEE: frozenset({_S.ARMED}),
}
"""The states in which a request may be accepted, if its guard holds."""

NEEDS_LEASE = frozenset(Request) - {Request.NONE, Request.STOP, Request.EMERGENCY_STOP, Request.DISARM}
"""Requests that need the lease; a request that ends motion never needs it."""


Table = list[list[int]]
"""Rows for a record of compiled code; without numpy, which clients of a bench do not load."""


def transition_table() -> Table:
    """Return TRANSITIONS as a 0/1 matrix [source][target] with a diagonal of 1."""
    table = [[int(source is target) for target in State] for source in State]
    for edge in TRANSITIONS:
        table[edge.source][edge.target] = 1
    return table


def accepted_table() -> Table:
    """Return ACCEPTED_IN as a table [request][state] of 0 and 1."""
    return [[int(state in ACCEPTED_IN[request]) for state in State] for request in Request]


READINGS_VALID, READINGS_LOST, EMERGENCY, ACTUATOR_FAULT, WRIST_FAULT, CHAMBER_SUSPECT = 0, 1, 2, 3, 4, 5
"""Columns of the stopping table: readings valid, readings lost, emergency stop with valid readings, actuator
fault of shoulder or arm, actuator fault of the wrist, pressure of one chamber alone that is suspect."""

_R = Reaction
_STANDING = (_R.VENT,) * 6
_SLOW = (_R.BRAKE, _R.BLIND_BRAKE, _R.BRAKE, _R.PASSIVE, _R.PASSIVE, _R.PASSIVE)
_STOPPABLE = (_R.BRAKE, _R.BLIND_BRAKE, _R.BRAKE, _R.PASSIVE, _R.BRAKE, _R.BRAKE)
_COMMITTED = (_R.COMPLETE, _R.BLIND_BRAKE, _R.BRAKE, _R.PASSIVE, _R.BRAKE, _R.BRAKE)
_BLOW = (_R.COMPLETE, _R.BLIND_BRAKE, _R.COMPLETE, _R.PASSIVE, _R.COMPLETE, _R.COMPLETE)

STOP_REACTIONS: dict[Phase, tuple[Reaction, Reaction, Reaction, Reaction, Reaction, Reaction]] = {
    Phase.STANDING: _STANDING,
    Phase.HOMING: _SLOW,
    Phase.HOLD: _SLOW,
    Phase.BACKSWING: _SLOW,
    Phase.TOP: _SLOW,
    Phase.DOWNSWING: _STOPPABLE,
    Phase.COMMITTED: _COMMITTED,
    Phase.IMPACT: _BLOW,
    Phase.FOLLOW_THROUGH: _BLOW,
    Phase.RETURN: _SLOW,
}
"""The stopping table; columns as above.

On loss of communication the device itself becomes PASSIVE. In the impact window and the follow-through
COMPLETE *is* the brake as planned. An actuator that does not follow its command may have a stuck valve, which
only a supply cut (PASSIVE) makes harmless. `golfbench profile check` shows why such a fault has a column
apart from valid readings. With a shoulder valve stuck open, detected within milliseconds by model-based fault
detection, a supply cut at once keeps the loads within the ratings. If the other joints brake with the supply
on, the loads reach 384 % of them. The wrist is the exception: while it is fast, it must be braked with the
supply on; otherwise its stop takes up to 168 %. A suspect pressure of one chamber alone indicates a faulty
sensor, since a faulty spool changes both chambers: past the no-return instant a brake with the supply on is
then safer than a supply cut."""


def reaction_table() -> Table:
    """Return the stopping table as a table [phase][column]."""
    return [[int(reaction) for reaction in STOP_REACTIONS[phase]] for phase in Phase]
