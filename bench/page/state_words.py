"""The state of a bench for its page: words for the operator, figures in SI for the browser's units."""

from __future__ import annotations

from typing import Any

from bench.lifecycle import ACCEPTED_IN, NEEDS_LEASE, Phase, Reaction, Request, State
from bench.network.bench_service import BenchStatus, CauseStatus
from bench.network.command import REQUESTS
from bench.network.status_words import (
    absent_monitor_text,
    block_text,
    interlock_conditions,
    robot_conditions,
    shut_off_words,
    vent_words,
)
from drivers.base import ACTUATORS, JOINTS

MOVING = frozenset({State.HOMING, State.ARMED, State.SWINGING, State.RECOVERING})
"""States in which the robot moves or may move."""
LATCHED = frozenset({State.ESTOP, State.FAULT})

STATE_WORDS = {
    State.STARTING: ("Starting", "Wait until the bench has started."),
    State.ESTOP: ("Stopped and latched", "Clear the cause, then reset."),
    State.SAFE: ("Vented, not homed", "Home the robot."),
    State.HOMING: ("Homing: the robot moves", "Wait until it is homed."),
    State.READY: ("Ready: vented and homed", "Arm to swing, or open the access to change club or ball."),
    State.ARMED: ("Armed: air on, the robot may move", "Swing once it rests at the address, or disarm."),
    State.SWINGING: ("Swinging: the robot moves at full speed", "Keep clear of the guard."),
    State.RECOVERING: ("Returning or braking: the robot moves", "Wait until it rests."),
    State.ACCESS: ("Access: vented, guard unlocked", "Close the guard, then end the access."),
    State.FAULT: ("Fault, latched", "Clear the cause, then reset."),
}
"""State and next step, for the operator; of a robot whose chambers are proven empty where it says vented."""

VENTING_WORDS = {
    State.ESTOP: (
        "Stopped and latched, not vented yet",
        "Stay outside until it is vented; clear the cause, then reset.",
    ),
    State.SAFE: ("Venting, not homed", "Wait until it is vented, then home the robot."),
    State.READY: ("Venting, homed", "Wait until it is vented."),
    State.ACCESS: ("Access, but a chamber shows pressure", "Leave the robot and close the guard."),
    State.FAULT: (
        "Fault, latched, not vented yet",
        "Stay outside until it is vented; clear the cause, then reset.",
    ),
}
"""The same of a standing robot whose chambers are not proven empty yet."""

ARMING_BLOCKED = "Remove what blocks arming, then arm; or open the access."
"""Next step of a bench that configuration, calibrations or profile keep from being armed."""

NO_BALL = "No ball is on the tee: raise one with Tee, or swing without."
"""Before the next step of an armed bench."""

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
    Reaction.COMPLETE: "completes this swing, then disarms",
    Reaction.BRAKE: "brakes with air on",
    Reaction.BLIND_BRAKE: "brakes by a fixed valve pattern, without readings",
    Reaction.PASSIVE: "spools centred, supply shut",
    Reaction.VENT: "vents",
}


def state_view(status: BenchStatus) -> dict[str, Any]:
    """Return `status` as the page shows it, valid as JSON."""
    state = State[status["state"]]
    known = STATE_WORDS[state]
    words, following = known if status["vented"] else VENTING_WORDS.get(state, known)
    if state is State.READY and status["arming_blocks"]:
        following = ARMING_BLOCKED
    if state is State.ARMED and not status["ball_present"]:
        following = f"{NO_BALL} {following}"
    chambers = status["chamber_pressure_pa"]
    sides = zip(ACTUATORS, chambers[::2], chambers[1::2], strict=True)
    return {
        "state": state.name,
        "tone": _tone(state, vented=status["vented"]),
        "words": words,
        "next": following,
        "phase": PHASE_WORDS[Phase[status["phase"]]],
        "reaction": _reaction(Reaction[status["reaction"]], vented=status["vented"]),
        "cause": _cause(status["cause"]),
        "latest_cause": _cause(status["latest_cause"]),
        "conditions": [c._asdict() for c in (*robot_conditions(status), *interlock_conditions(status))],
        "joints": [
            {"name": name, "deg": angle} for name, angle in zip(JOINTS, status["joints_deg"], strict=True)
        ],
        "chambers": [{"name": name, "a_pa": a, "b_pa": b} for name, a, b in sides],
        "vents": vent_words(status["vents_open"]),
        "shut_off": shut_off_words(status["shut_off_open"]),
        "warnings": _warnings(status),
        "accepts": accepted_commands(state),
        **{name: status[name] for name in _UNCHANGED},  # type: ignore[literal-required]
    }


def _reaction(reaction: Reaction, *, vented: bool) -> str:
    """Return the words of `reaction`; none for a venting that is over."""
    return "" if reaction is Reaction.VENT and vented else REACTION_WORDS[reaction]


def _tone(state: State, *, vented: bool) -> str:
    """Return the colour of `state`: stopped, moving, ready or rest."""
    if state in LATCHED:
        return "stopped"
    if state in MOVING:
        return "moving"
    return "ready" if state is State.READY and vented else "rest"


_UNCHANGED = (
    "bench",
    "tick",
    "time",
    "lease",
    "supply_pressure_pa",
    "loop",
    "swings",
    "profile",
    "correction",
    "club",
    "series",
    "driver",
    "ball_present",
    "vented",
    "guard_closed",
    "uptime",
    "last_stop",
)


def accepted_commands(state: State) -> list[str]:
    """Return the commands that the bench may accept in `state`, apart from the stops."""
    return sorted(
        str(verb)
        for verb, request in REQUESTS.items()
        if state in ACCEPTED_IN[request] and request in NEEDS_LEASE | {Request.DISARM}
    )


def split_cure(text: str) -> tuple[str, str]:
    """Return the fact and the cure of a text of `bench.lifecycle`, the cure as a sentence or empty."""
    what, _, cure = text.partition(": ")
    return f"{what[:1].upper()}{what[1:]}.", f"{cure[:1].upper()}{cure[1:]}." if cure else ""


def _cause(cause: CauseStatus | None) -> dict[str, str] | None:
    if cause is None:
        return None
    what, cure = split_cure(cause["text"])
    return {"name": cause["name"], "what": what, "cure": cure}


def _warnings(status: BenchStatus) -> list[str]:
    """Return what needs attention: readiness, air, drift, device, processes, launch monitor."""
    found = [f"arming blocked: {block_text(block)}" for block in status["arming_blocks"]]
    found += [*status["readiness_warnings"], *status["air_faults"], *status["drift"]]
    if trouble := status["device"]["trouble"]:
        found.append(f"device: {trouble}")
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
    if status["read_only"]:
        found.append("read only: the bench observes and sends nothing but safe outputs")
    return found
