"""The state of a bench for its page: words for the operator, figures in SI for the browser's units."""

from __future__ import annotations

from typing import Any

from bench.lifecycle import ACCEPTED_IN, NEEDS_LEASE, Phase, Reaction, Request, State
from bench.network.bench_service import BenchStatus, CauseStatus
from bench.network.command import REQUESTS
from bench.network.status_words import (
    LATCHED,
    MOVING,
    PHASE_WORDS,
    REACTION_WORDS,
    absent_monitor_text,
    block_text,
    interlock_conditions,
    next_step,
    robot_conditions,
    sentence,
    shut_off_words,
    state_words,
    vent_words,
)
from drivers.base import ACTUATORS, JOINTS


def state_view(status: BenchStatus) -> dict[str, Any]:
    """Return `status` as the page shows it, valid as JSON."""
    state = State[status["state"]]
    chambers = status["chamber_pressure_pa"]
    sides = zip(ACTUATORS, chambers[::2], chambers[1::2], strict=True)
    return {
        "state": state.name,
        "tone": _tone(state, vented=status["vented"]),
        "words": state_words(status),
        "next": next_step(status),
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


def _cause(cause: CauseStatus | None) -> dict[str, str] | None:
    if cause is None:
        return None
    return {"name": cause["name"], "what": sentence(cause["text"]), "cure": sentence(cause["cure"])}


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
    if (lease := status["lease"]) is not None and lease["lapsing"]:
        found.append(f"the lease of {lease['holder']} lapses soon unless renewed: an armed bench disarms")
    if status["read_only"]:
        found.append("read only: the bench observes and sends nothing but safe outputs")
    return found
