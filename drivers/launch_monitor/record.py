"""Launch monitor records of one ball each, and their assignment to swings.

A record is in SI, each figure known or absent with a reason. It is assigned by the time between impact and
the monitor's message. A monitor reports a shot with a delay, and may report it twice, not at all, or report
one without a swing. Each case is a separate outcome; nothing is guessed and nothing is dropped.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated, NamedTuple

from drivers.base import Launch
from drivers.base.ranges import Above, AtMost

SOURCE = "launch monitor"
"""Source of these values; the others are `encoders+model` and `simulated`."""


class ClubFigures(NamedTuple):
    """Club delivery: m/s, rad, m; None if not measured.

    Angles are positive up or to the right of the target line, the strike towards the toe and up from the
    centre of the face. Definitions differ between manufacturers; the bench's encoders are more accurate.
    """

    speed: float | None = None
    attack_angle: float | None = None
    path: float | None = None
    face_angle: float | None = None
    dynamic_loft: float | None = None
    strike_x: float | None = None
    strike_y: float | None = None


NO_CLUB = ClubFigures()
_OF_BALL = (*Launch._fields, "carry")


class ClubRecord(NamedTuple):
    """Club figures of a message without a ball: never a launch, but part of one."""

    time: float
    """Time of the message's last byte, CLOCK_MONOTONIC (s)."""
    device: str
    club: ClubFigures
    absent: tuple[tuple[str, str], ...] = ()
    """Missing figures with the reason."""


class RefusedRecord(NamedTuple):
    """A message that was refused."""

    time: float
    """Time of the message's last byte, CLOCK_MONOTONIC (s)."""
    reason: str


@dataclass(frozen=True)
class LaunchRecord:
    """One shot of a monitor; the five figures have the signs and units of `drivers.base.Launch`."""

    time: float
    """Time of the message's last byte, CLOCK_MONOTONIC (s)."""
    device: str
    number: int | None
    """Shot number of the device; it may restart."""
    speed: float | None = None
    launch_angle: float | None = None
    direction: float | None = None
    spin: float | None = None
    spin_axis: float | None = None
    carry: float | None = None
    """Carry estimated by the monitor, m."""
    club: ClubFigures = NO_CLUB
    absent: tuple[tuple[str, str], ...] = ()
    """Missing figures with the reason."""
    doubts: tuple[str, ...] = ()
    """Reasons to distrust the figures: such a record is kept and shown, but not counted."""
    source: str = SOURCE

    @property
    def launch(self) -> Launch | None:
        """The five figures for the flight if all are known, regardless of doubts."""
        figures = (self.speed, self.launch_angle, self.direction, self.spin, self.spin_axis)
        known = [figure for figure in figures if figure is not None]
        return Launch(*known) if len(known) == len(figures) else None

    @property
    def valid(self) -> bool:
        """Whether all five values are known and plausible."""
        return self.launch is not None and not self.doubts

    @property
    def reason(self) -> str:
        """Why it is invalid; empty if valid."""
        missing = (f"no {name}: {why}" for name, why in self.absent if name in Launch._fields)
        return "; ".join([*missing, *self.doubts])

    def completed_by(self, other: LaunchRecord | ClubRecord) -> LaunchRecord:
        """Return the record with the figures of `other` that it lacks."""
        club = ClubFigures(*(b if a is None else a for a, b in zip(self.club, other.club, strict=True)))
        ball = {name: getattr(self, name) for name in _OF_BALL}
        if isinstance(other, LaunchRecord):
            ball = {name: getattr(other, name) if value is None else value for name, value in ball.items()}
        if club == self.club and all(getattr(self, name) == value for name, value in ball.items()):
            return self
        lacking = {name for name, value in ball.items() if value is None}
        lacking |= {f"club.{name}" for name, value in club._asdict().items() if value is None}
        absent = dict.fromkeys(each for each in (*self.absent, *other.absent) if each[0] in lacking)
        return replace(self, club=club, absent=tuple(absent), **ball)

    def is_repeat_of(self, other: LaunchRecord) -> bool:
        """Whether it is the ball of `other`: sent again, or completed by figures that `other` lacks."""
        pairs = [(getattr(self, name), getattr(other, name)) for name in _OF_BALL]
        known = [a == b for a, b in pairs if a is not None and b is not None]
        whole = self.launch is not None and self.launch == other.launch
        completed = (self.club == NO_CLUB) != (other.club == NO_CLUB) and all(a == b for a, b in pairs)
        same = bool(known) and all(known) and self.device == other.device
        return same and (self.number == other.number or whole or completed)


EARLIEST = 0.1
"""Lead of the matching window before the impact (s): the two times are taken in different processes."""
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
            joined[n] = joined[n].completed_by(club)
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
    """Repeat of a matched launch: the monitor got no answer and retried, or completed it."""
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
            first = first.completed_by(later)
    doubles = sum(other.outcome is MatchOutcome.DOUBLE for other in others)
    reason = f"{doubles + 1} different launches after one swing" if doubles else ""
    return [Match(MatchOutcome.MATCHED, swing.shot, first, reason), *others]
