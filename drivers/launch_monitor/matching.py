"""Assign launches to swings by the time between impact and the monitor's message.

A monitor reports a shot with a delay, and may report it twice, not at all, or report one without a swing.
Each case is a separate outcome; nothing is guessed and nothing is dropped.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, NamedTuple

from drivers.base.ranges import Above, AtMost
from drivers.launch_monitor.record import NO_CLUB, ClubRecord, LaunchRecord

EARLIEST = 0.1
"""Begin of a window before the impact, s: the two times are taken in different processes."""
CLUB_DELAY = 3.0
"""Maximum time between the messages of ball and club of one shot, s: monitors that send two take about one
second for the second, and the robot needs six from one swing to the next."""


@dataclass(frozen=True)
class MatchWindow:
    """Time window around the impact for a launch; it ends at the latest where the next swing's begins."""

    latest: Annotated[float, Above(0.0), AtMost(60.0)] = 8.0
    """End of the window after the impact, s; the slowest monitors process images for some seconds."""
    timeout: Annotated[float, Above(0.0), AtMost(120.0)] = 15.0
    """Time for which a launch waits for its swing, s; a swing is reported when the robot stands again."""


def join_clubs(
    launches: Sequence[LaunchRecord], clubs: Iterable[ClubRecord]
) -> tuple[list[LaunchRecord], list[ClubRecord]]:
    """Return `launches` with the figures of `clubs`, and the clubs that belong to none of them.

    A club belongs to the nearest launch of its device within CLUB_DELAY, before those that have a club.
    """
    joined, alone = list(launches), list[ClubRecord]()
    for club in clubs:
        near = [
            (one.club != NO_CLUB, abs(one.time - club.time), n)
            for n, one in enumerate(joined)
            if one.device == club.device and abs(one.time - club.time) <= CLUB_DELAY
        ]
        if near:
            n = min(near)[2]
            joined[n] = joined[n].with_club(club.club, club.absent)
        else:
            alone.append(club)
    return joined, alone


class SwingImpact(NamedTuple):
    """A swing that should have launched a ball."""

    shot: str
    """Shot id, copied into the match."""
    time: float
    """Time of the impact, s (CLOCK_MONOTONIC)."""


class MatchOutcome(StrEnum):
    """Outcome of a swing or a launch."""

    MATCHED = "matched"
    NO_LAUNCH = "swing without a launch"
    NO_SWING = "launch without a swing"
    REPEATED = "launch sent again"
    """Repeat of the matched launch: the monitor got no answer and retried, or completed it with its club."""
    DOUBLE = "second launch of a swing"
    """Another launch in the same swing's window: ambiguous."""


class Match(NamedTuple):
    """One decided outcome. `shot` is "" without a swing, `launch` None without a launch."""

    outcome: MatchOutcome
    shot: str
    launch: LaunchRecord | None
    reason: str = ""
    """Reason if ambiguous."""


class Matching(NamedTuple):
    """Decided outcomes, and the swings and launches still open, to be passed to the next call."""

    decided: tuple[Match, ...]
    swings: tuple[SwingImpact, ...]
    launches: tuple[LaunchRecord, ...]


def match(
    swings: Iterable[SwingImpact], launches: Iterable[LaunchRecord], now: float, window: MatchWindow
) -> Matching:
    """Return the outcomes of `swings` and `launches` that are settled at `now` (s, their clock).

    A launch belongs to the last swing before it, if that swing's window contains it. A swing is settled at
    the end of its window (`latest` after its impact, or at the next swing's window), so that doubles are
    detected; a launch without a swing after `timeout`. Ties in time keep the given order.

    Raises:
        ValueError: two swings have the same id.
    """
    ordered = sorted(swings, key=lambda swing: swing.time)
    if len({swing.shot for swing in ordered}) != len(ordered):
        raise ValueError(f"two swings have the same id among {', '.join(swing.shot for swing in ordered)}")
    of_swing: dict[str, list[LaunchRecord]] = {swing.shot: [] for swing in ordered}
    decided: list[Match] = []
    open_launches: list[LaunchRecord] = []
    for launch in sorted(launches, key=lambda launch: launch.time):
        owner = owner_of(launch.time, ordered, window)
        if owner is not None:
            of_swing[owner.shot].append(launch)
        elif now - launch.time > window.timeout:
            decided.append(Match(MatchOutcome.NO_SWING, "", launch))
        else:
            open_launches.append(launch)
    open_swings: list[SwingImpact] = []
    for n, swing in enumerate(ordered):
        if now > _end(n, ordered, window):
            decided += _settle(swing, of_swing[swing.shot])
        else:
            open_swings.append(swing)
            open_launches += of_swing[swing.shot]
    return Matching(tuple(decided), tuple(open_swings), tuple(open_launches))


def _end(n: int, ordered: Sequence[SwingImpact], window: MatchWindow) -> float:
    """Return the end of the window of swing `n`."""
    end = ordered[n].time + window.latest
    return end if n + 1 == len(ordered) else min(end, ordered[n + 1].time - EARLIEST)


def owner_of(time: float, ordered: Sequence[SwingImpact], window: MatchWindow) -> SwingImpact | None:
    """Return the swing of `ordered`, by time, whose window contains `time`, else None."""
    before = [swing for swing in ordered if swing.time - EARLIEST <= time]
    return before[-1] if before and time <= before[-1].time + window.latest else None


def _settle(swing: SwingImpact, launches: Sequence[LaunchRecord]) -> list[Match]:
    """Return the outcomes of a swing and all launches in its window."""
    if not launches:
        return [Match(MatchOutcome.NO_LAUNCH, swing.shot, None)]
    first, *rest = launches
    others = [
        Match(MatchOutcome.REPEATED if later.is_repeat_of(first) else MatchOutcome.DOUBLE, swing.shot, later)
        for later in rest
    ]
    for later, other in zip(rest, others, strict=True):
        if other.outcome is MatchOutcome.REPEATED:
            first = first.with_club(later.club, later.absent)
    doubles = sum(other.outcome is MatchOutcome.DOUBLE for other in others)
    reason = f"{doubles + 1} different launches after one swing" if doubles else ""
    return [Match(MatchOutcome.MATCHED, swing.shot, first, reason), *others]
