"""Which launch belongs to which swing, by the time between impact and the monitor's message.

A monitor needs a moment to tell of a shot, and may tell of it twice, not at all, or of one that no swing of
ours made. Each of that is an outcome of its own; nothing is guessed and nothing is thrown away.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, NamedTuple

from annotated_types import Ge, Gt, Le

from drivers.launch_monitor.record import LaunchRecord


@dataclass(frozen=True)
class MatchWindow:
    """How far from the impact a launch may be told; a swing's window ends where the next one's begins."""

    earliest: Annotated[float, Ge(0.0), Le(1.0)] = 0.1
    """s before the impact: the two times are taken in different processes."""
    latest: Annotated[float, Gt(0.0), Le(60.0)] = 8.0
    """s after the impact; the slowest monitors process images for some seconds."""
    patience: Annotated[float, Gt(0.0), Le(120.0)] = 15.0
    """s that a launch waits for its swing to be told, which happens when the robot stands still again."""


class SwingImpact(NamedTuple):
    """A swing that should have launched a ball."""

    shot: str
    """The shot's id; it goes from here into the match, and with it to the launch."""
    time: float
    """s, CLOCK_MONOTONIC, of the impact."""


class MatchOutcome(StrEnum):
    """What became of a swing or of a launch."""

    MATCHED = "matched"
    NO_LAUNCH = "swing without a launch"
    NO_SWING = "launch without a swing"
    REPEATED = "launch sent again"
    """Equal to the one that is matched: the monitor had no answer and tried again."""
    DOUBLE = "second launch of a swing"
    """Another one in the same swing's window: which of the two is right nobody can tell."""


class Match(NamedTuple):
    """One decided outcome. `shot` is "" when there is no swing, `launch` None when there is none."""

    outcome: MatchOutcome
    shot: str
    launch: LaunchRecord | None
    reason: str = ""
    """In doubt: why."""


class Matching(NamedTuple):
    """What is decided, and what is still open: to be asked again together with what came since."""

    decided: tuple[Match, ...]
    swings: tuple[SwingImpact, ...]
    launches: tuple[LaunchRecord, ...]


def match(
    swings: Iterable[SwingImpact], launches: Iterable[LaunchRecord], now: float, window: MatchWindow
) -> Matching:
    """Return the outcomes of `swings` and `launches` that are settled at `now` (s, their clock).

    A launch belongs to the last swing before it, if that one's window holds it. A swing is settled when its
    window is over (`latest` after its impact, or at the next swing's beginning), so that a double is seen;
    a launch without a swing after `patience`. Ties in time keep the order given.

    Raises:
        ValueError: two swings have one id.
    """
    ordered = sorted(swings, key=lambda swing: swing.time)
    if len({swing.shot for swing in ordered}) != len(ordered):
        raise ValueError(f"two swings have one id among {', '.join(swing.shot for swing in ordered)}")
    of_swing: dict[str, list[LaunchRecord]] = {swing.shot: [] for swing in ordered}
    decided: list[Match] = []
    open_launches: list[LaunchRecord] = []
    for launch in sorted(launches, key=lambda launch: launch.time):
        owner = _owner(launch.time, ordered, window)
        if owner is not None:
            of_swing[owner.shot].append(launch)
        elif now - launch.time > window.patience:
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
    """Return when the window of swing `n` is over."""
    end = ordered[n].time + window.latest
    return end if n + 1 == len(ordered) else min(end, ordered[n + 1].time - window.earliest)


def _owner(time: float, ordered: Sequence[SwingImpact], window: MatchWindow) -> SwingImpact | None:
    before = [swing for swing in ordered if swing.time - window.earliest <= time]
    return before[-1] if before and time <= before[-1].time + window.latest else None


def _settle(swing: SwingImpact, launches: Sequence[LaunchRecord]) -> list[Match]:
    """Return the outcomes of a swing and of all launches in its window."""
    if not launches:
        return [Match(MatchOutcome.NO_LAUNCH, swing.shot, None)]
    first, *rest = launches
    others = [
        Match(
            MatchOutcome.REPEATED if later.tells_the_same(first) else MatchOutcome.DOUBLE, swing.shot, later
        )
        for later in rest
    ]
    doubles = sum(other.outcome is MatchOutcome.DOUBLE for other in others)
    reason = f"{doubles + 1} different launches after one swing" if doubles else ""
    return [Match(MatchOutcome.MATCHED, swing.shot, first, reason), *others]
