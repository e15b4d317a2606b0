"""Words for parts of a bench's status, the same at the terminal and on the page."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

from bench.errors import BenchError
from bench.network.bench_service import ArmingBlock, BenchStatus, LaunchMonitorStatus


class StatusCondition(NamedTuple):
    """A condition of the bench."""

    text: str
    """Words for its present state."""
    holds: bool
    """Whether it is as it must be to move."""


def robot_conditions(status: BenchStatus) -> list[StatusCondition]:
    """Return the conditions of the robot."""
    return [
        _condition("homed", "not homed", status["homed"]),
        _condition("vented", "not vented", status["vented"]),
    ]


def interlock_conditions(status: BenchStatus) -> list[StatusCondition]:
    """Return the conditions of emergency stop circuit and guard."""
    return [
        _condition("e-stop clear", "e-stop open", status["emergency_stop_clear"]),
        _condition("guard closed", "guard open", status["guard_closed"]),
        _condition("guard locked", "guard not locked", status["guard_locked"]),
    ]


def block_text(block: ArmingBlock) -> str:
    """Return a reason that blocks arming as an error message."""
    return str(BenchError(block["place"], block["found"], block["expected"], block["cure"]))


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
        return ", ".join(one["device"] or one["address"] for one in link["monitors"]) or "not connected"
    if (seen := link["seen_s"]) is None:
        return "connects per shot, not seen so far"
    return f"connects per shot, seen within {max(1, ceil(seen / 60.0))} min"


def absent_monitor_text(link: LaunchMonitorStatus) -> str:
    """Return the warning of a launch monitor that is not present."""
    if link["presence"] == "connected":
        return "no launch monitor is connected"
    return f"the launch monitor reports no ball: {launch_monitor_text(link)}"


def _condition(yes: str, no: str, holds: bool) -> StatusCondition:
    return StatusCondition(yes if holds else no, holds)
