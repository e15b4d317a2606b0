"""Words for parts of a bench's status, the same at the terminal and on the page."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

from bench.base.errors import BenchError
from bench.base.lifecycle import Block, Phase, Reaction, State
from bench.network.bench_service import (
    BAR_HOMING,
    ArmingBlock,
    BenchStatus,
    LaunchMonitorStatus,
    MonitorStatus,
)

STATE_WORDS = {
    State.STARTING: ("Not ready yet", "Wait until the bench has started."),
    State.ESTOP: ("Stopped and latched", "Clear the cause, then reset."),
    State.SAFE: ("Vented, not homed", "Home the robot."),
    State.HOMING: ("The robot moves", "Wait until it is homed."),
    State.READY: ("Vented and homed", "Arm to swing, or open the access to change club or ball."),
    State.ARMED: ("Air on, the robot may move", "Swing once it rests at the address, or disarm."),
    State.SWINGING: ("The robot moves at full speed", "Keep clear of the guard."),
    State.RECOVERING: ("Returning or braking: the robot moves", "Wait until it rests."),
    State.ACCESS: ("Vented, guard unlocked", "Close the guard, then end the access."),
    State.FAULT: ("Latched", "Clear the cause, then reset."),
}
"""State and next step, for the operator; "vented" means that the chambers are verified empty."""

COMMANDS = {
    State.STARTING: "golfbench status --watch",
    State.ESTOP: "golfbench reset",
    State.SAFE: "golfbench home --wait",
    State.HOMING: "golfbench status --watch",
    State.READY: "golfbench arm --wait",
    State.ARMED: "golfbench swing",
    State.SWINGING: "golfbench status --watch",
    State.RECOVERING: "golfbench status --watch",
    State.ACCESS: "golfbench access --end",
    State.FAULT: "golfbench reset",
}
"""Command of the next step."""

VENTING_WORDS = {
    State.ESTOP: (
        "Stopped and latched, not vented yet",
        "Stay outside until it is vented; clear the cause, then reset.",
    ),
    State.SAFE: ("Venting, not homed", "Wait until it is vented, then home the robot."),
    State.READY: ("Venting, homed", "Arm to swing once it is vented."),
    State.ACCESS: ("Guard unlocked, but a chamber shows pressure", "Leave the robot and close the guard."),
    State.FAULT: ("Latched, not vented yet", "Stay outside until it is vented; clear the cause, then reset."),
}
"""Words for the states of a standing robot whose chambers are not proven empty yet."""

ARMING_BLOCKED = "Remove what blocks arming, then arm; or open the access."
"""Next step of a bench that configuration, calibrations or profile keep from being armed."""

HOMING_BLOCKED = "Remove the block of homing, then home the robot."
"""Next step of a bench whose inputs or calibrations keep it from being homed."""

CHECK_INPUTS = "golfbench calibrate inputs, once golfbench run has ended"
"""Command of a check of the inputs, which takes the bench's place."""

NO_BALL = "No ball is on the tee: raise one with Tee, or swing without."
"""Hint before the next step of an armed bench."""

PHASE_WORDS = {
    Phase.STANDING: "standing",
    Phase.HOMING: "homing",
    Phase.HOLD: "holding the address",
    Phase.BACKSWING: "backswing",
    Phase.TOP: "top of the swing",
    Phase.DOWNSWING: "downswing, can still be stopped short of the ball",
    Phase.COMMITTED: "downswing, past the point of no return",
    Phase.IMPACT: "impact",
    Phase.FOLLOW_THROUGH: "follow-through",
    Phase.RETURN: "returning",
}

REACTION_WORDS = {
    Reaction.NONE: "",
    Reaction.COMPLETE: "completes this swing, then brakes, vents and latches the stop",
    Reaction.BRAKE: "brakes with air on",
    Reaction.BLIND_BRAKE: "brakes by a fixed valve pattern, without readings",
    Reaction.PASSIVE: "spools centred, supply shut",
    Reaction.VENT: "vents",
}


def state_words(status: BenchStatus) -> str:
    """Return the state of the bench in words, for the operator."""
    return _words_of(status)[0]


def next_step(status: BenchStatus) -> str:
    """Return the next step in the state of the bench, for the operator."""
    following = _words_of(status)[1]
    if status["state"] == State.READY.name and status["arming_blocks"]:
        return ARMING_BLOCKED
    if _homing_blocks(status):
        return HOMING_BLOCKED
    armed_without_ball = status["state"] == State.ARMED.name and not status["ball_present"]
    return f"{NO_BALL} {following}" if armed_without_ball else following


def next_command(status: BenchStatus) -> str:
    """Return the command of the next step."""
    if status["state"] == State.READY.name and status["arming_blocks"]:
        return "golfbench status"
    if blocks := _homing_blocks(status):
        return CHECK_INPUTS if Block.INPUTS in blocks else "golfbench status"
    if status["state"] == State.ARMED.name and not status["ball_present"]:
        return "golfbench tee, or golfbench swing without a ball"
    return COMMANDS[State[status["state"]]]


def _homing_blocks(status: BenchStatus) -> set[Block]:
    """Return the reasons that keep a robot in SAFE from being homed."""
    safe = status["state"] == State.SAFE.name
    return {block["code"] for block in status["arming_blocks"] if safe} & BAR_HOMING


def state_line(status: BenchStatus) -> str:
    """Return state, cause and next command in one line; in ACCESS first whether it is vented."""
    cause = status["cause"]
    fact = sentence(cause["text"]) if cause else ""
    if not cause or status["state"] == State.ACCESS.name:
        fact = f"{state_words(status)}. {fact}".rstrip()
    return f"bench {status['bench']}: {status['state']}. {fact} Next: {next_command(status)}"


def _words_of(status: BenchStatus) -> tuple[str, str]:
    state = State[status["state"]]
    known = STATE_WORDS[state]
    return known if status["vented"] else VENTING_WORDS.get(state, known)


def sentence(text: str) -> str:
    """Return `text` as a sentence; empty without one."""
    return f"{text[:1].upper()}{text[1:]}." if text else ""


class StatusCondition(NamedTuple):
    """A condition of the bench."""

    text: str
    """Words for its present state."""
    holds: bool
    """Whether the condition permits motion."""


def robot_conditions(status: BenchStatus) -> list[StatusCondition]:
    """Return the conditions of the robot."""
    return _conditions(("homed", "not homed", status["homed"]), ("vented", "not vented", status["vented"]))


def interlock_conditions(status: BenchStatus) -> list[StatusCondition]:
    """Return the conditions of emergency stop circuit and guard."""
    return _conditions(
        ("e-stop clear", "e-stop open", status["emergency_stop_clear"]),
        ("guard closed", "guard open", status["guard_closed"]),
        ("guard locked", "guard not locked", status["guard_locked"]),
    )


def block_text(block: ArmingBlock) -> str:
    """Return a reason that blocks arming as an error message."""
    return str(BenchError(block["location"], block["found"], block["expected"], block["action"]))


_POSITION = {True: "open", False: "shut", None: "no feedback"}


def vent_words(positions: Sequence[bool | None]) -> str:
    """Return the positions of the vents; None: without feedback."""
    return ", ".join(f"{number} {_POSITION[position]}" for number, position in enumerate(positions, start=1))


def shut_off_words(position: bool | None) -> str:
    """Return the position of the shut-off valve; None: without feedback."""
    return _POSITION[position]


def launch_monitor_text(link: LaunchMonitorStatus) -> str:
    """Return which monitors are connected, or when one that connects per shot was seen."""
    if link["presence"] == "connected":
        return ", ".join(map(_monitor_text, link["monitors"])) or "not connected"
    if (seen := link["seen_s"]) is None:
        return "connects per shot, not seen so far"
    return f"connects per shot, seen within {max(1, ceil(seen / 60.0))} min"


def _monitor_text(monitor: MonitorStatus) -> str:
    ready = " (reports itself not ready)" if monitor["ready"] is False else ""
    return f"{monitor['device'] or monitor['address']}{ready}"


def absent_monitor_text(link: LaunchMonitorStatus) -> str:
    """Return the warning of a launch monitor that is not present."""
    if link["presence"] == "connected":
        return "no launch monitor is connected"
    return f"the launch monitor reports no ball: {launch_monitor_text(link)}"


def warning_texts(status: BenchStatus) -> list[str]:
    """Return the warnings to the operator: readiness, air, drift, wear, device, processes, launch monitor."""
    found = [f"arming blocked: {block_text(block)}" for block in status["arming_blocks"]]
    found += [*status["readiness_warnings"], *status["air_faults"], *status["drift"]]
    found += [f"wear seen {one['time_utc'][:10]}, {one['text']}" for one in status["wear"]]
    if fault := status["device"]["fault"]:
        found.append(f"device: {fault}")
    for name, process in status["processes"].items():
        if not process["alive"]:
            found.append(": ".join(filter(None, (f"process {name} is not running", process["note"]))))
    if not status["support_ready"]:
        found.append("nothing is armed without recorder and publisher")
    monitor = status["launch_monitor"]
    if monitor is not None and not monitor["present"]:
        found.append(absent_monitor_text(monitor))
    if monitor is not None and monitor["note"]:
        found.append(f"launch monitor: {monitor['note']}")
    if (lease := status["lease"]) is not None and lease["lapsing"]:
        found.append(f"the lease of {lease['holder']} lapses soon unless renewed: an armed bench disarms")
    if status["read_only"]:
        found.append("read only: the bench observes and sends nothing but safe outputs")
    return found


def _conditions(*rows: tuple[str, str, bool]) -> list[StatusCondition]:
    return [StatusCondition(yes if holds else no, holds) for yes, no, holds in rows]
