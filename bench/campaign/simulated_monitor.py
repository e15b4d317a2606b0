"""The simulated launch monitor in lock-step: its messages through the bench's own reading and matching.

No sockets and no clock: the bytes that the monitor would send go straight to where the server would have them
from, at the times they would come.
"""

from __future__ import annotations

from typing import NamedTuple

from bench.shot.shot_matcher import NOT_TOLD
from drivers.base import Launch
from drivers.launch_monitor.conversation import Conversation
from drivers.launch_monitor.matching import Match, MatchOutcome, MatchWindow, SwingImpact, match
from drivers.launch_monitor.plausibility import add_doubts
from drivers.launch_monitor.record import LaunchRecord
from sim.launch_monitor import MonitorParameters, monitor_messages


class MonitorResult(NamedTuple):
    """Result of a shot at the launch monitor."""

    launch: LaunchRecord | None
    reason: str
    """Why its figures are missing or invalid; empty if they are valid."""


def hear(
    launch: Launch,
    number: int,
    club_speed: float | None,
    parameters: MonitorParameters,
    window: MatchWindow,
    carry: float | None = None,
) -> MonitorResult:
    """Return what a bench hears of ball `number` that left with `launch`; `club_speed` (m/s) is its own.

    `carry` (m) is the monitor's.
    """
    talk, records = Conversation(0.0), list[LaunchRecord]()
    for delay, message in monitor_messages(launch, number, parameters, carry=carry):
        records += talk.receive(message, delay).records
    late = window.latest + window.patience
    swing = SwingImpact(str(number), 0.0)
    found: Match = next(
        one for one in match([swing], records, late + 1.0, window).decided if one.shot == swing.shot
    )
    if found.outcome is MatchOutcome.NO_LAUNCH or found.launch is None:
        return MonitorResult(None, NOT_TOLD)
    record = add_doubts(found.launch, club_speed)
    return MonitorResult(record, "; ".join(filter(None, (found.reason, record.reason))))
