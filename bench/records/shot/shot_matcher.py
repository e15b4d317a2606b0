"""Matching of swings and launches of a running bench: pure, time is an argument.

A launch finds its swing by time (`drivers.launch_monitor.record`); a match gives a shot with the
club measured by the encoders and the ball by the monitor. Its flight is the reference ball's.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime
from itertools import pairwise
from math import degrees, pi
from typing import Any, NamedTuple

import numpy as np

from bench.base.lifecycle import CAUSE_TEXT, Cause, Phase, State
from bench.records.shot.recorded_shot import FlightConditions, delivery_of_cycles
from bench.records.shot.shot import Shot, ShotStatus, delivery_columns, flight_columns
from bench.records.shot.strike import ball_struck
from bench.records.telemetry.swing_metadata import shot_id
from drivers.launch_monitor.conversation import add_doubts
from drivers.launch_monitor.record import (
    ClubRecord,
    LaunchRecord,
    Match,
    MatchOutcome,
    MatchWindow,
    RefusedRecord,
    SwingImpact,
    join_clubs,
    match,
    owner_of,
)
from sim.ball import REFERENCE_BALL
from sim.flight import Flight
from sim.plant import PlantParameters

Cycles = np.ndarray[Any, Any]

_MAX_CYCLES = 30_000
"""Cycles that are kept of a swing."""
_AT_THE_BALL = (Phase.COMMITTED, Phase.IMPACT, Phase.FOLLOW_THROUGH)


class FinishedSwing(NamedTuple):
    """A swing that is over."""

    shot: str
    """Its id."""
    impact: float | None
    """Time at which the head reached the ball's place (s, CLOCK_MONOTONIC); None if it did not."""
    struck: bool
    """A ball lay on the tee until then."""
    cycles: Cycles
    """Cycles of the swing, and the one after it."""


class SwingWatch:
    """Finds swings in the ring of one run of the loop: each with its id, its cycles, its impact."""

    def __init__(self, run: str, *, wall: bool) -> None:
        """`run` is its id; `wall`: the loop's time is CLOCK_MONOTONIC, otherwise virtual."""
        self._run, self._wall = run, wall
        self._state = State.SWINGING
        """State in the cycle before; a swing under way at the start has no beginning, and so no id."""
        self._parts: list[Cycles] | None = None
        self._behind: list[float] = []
        """CLOCK_MONOTONIC less loop's time, s, of each part: a loop in step with a plant slips."""

    def take(self, cycles: Cycles, now: float, *, lost: bool = False) -> list[FinishedSwing]:
        """Take new `cycles` read at `now` (s, CLOCK_MONOTONIC); return the swings that ended in them.

        They are kept as they are, not copied. `lost`: the ring has
        lost cycles before these, and with them the swing under way.
        """
        if lost:
            self._state, self._parts = State.SWINGING, None
        ended: list[FinishedSwing] = []
        if not len(cycles):
            return ended
        swinging = cycles["state"] == State.SWINGING
        before = np.concatenate([[self._state == State.SWINGING], swinging[:-1]])
        edges = [0, *np.flatnonzero(swinging != before).tolist(), len(cycles)]
        behind = 0.0 if self._wall else now - float(cycles["time"][-1])
        for first, last in pairwise(edges):
            if first == last:
                continue
            if not swinging[first]:
                if self._parts is not None:  # the cycle that ended it gives the reason
                    self._parts.append(cycles[first : first + 1])
                    self._behind.append(behind)
                    ended.append(self._end(self._parts))
                continue
            if not before[first]:
                self._parts, self._behind = [], []
            if self._parts is not None:
                self._parts.append(cycles[first:last])
                self._behind.append(behind)
                if sum(map(len, self._parts)) > _MAX_CYCLES:
                    self._parts = None
        self._state = State(int(cycles["state"][-1]))
        return ended

    def _end(self, parts: list[Cycles]) -> FinishedSwing:
        # As bytes: numpy joins records field by field.
        whole = np.concatenate([part.view(np.uint8) for part in parts]).view(parts[0].dtype)
        behind = np.repeat(self._behind, [len(part) for part in parts])
        self._parts = None
        at = _impact(whole)
        impact = None if at is None else float(whole["time"][at] + behind[at])
        return FinishedSwing(shot_id(self._run, int(whole["tick"][0])), impact, ball_struck(whole), whole)


def _impact(cycles: Cycles) -> int | None:
    """Return the first cycle after the impact: the ball is gone, or its window has started."""
    at_the_ball = np.isin(cycles["phase"], _AT_THE_BALL)
    there = cycles["ball_present"].astype(bool)
    gone = np.flatnonzero(at_the_ball[1:] & there[:-1] & ~there[1:])
    if len(gone):
        return int(gone[0]) + 1
    passed = np.flatnonzero(np.isin(cycles["phase"], (Phase.IMPACT, Phase.FOLLOW_THROUGH)))
    return int(passed[0]) if len(passed) else None


NO_IMPACT = "no swing through the ball's place"
NO_BALL = "no ball struck"
UNREPORTED = "the launch monitor saw no ball"
REFUSED = "the launch monitor's message was refused"
CLUB_ALONE = "the launch monitor reported the club without a ball"
_MAX_OPEN = 64
"""Launches that may wait for their swing; beyond that the oldest are given up as unmatched."""


class SettledOutcome(NamedTuple):
    """One outcome that is settled."""

    outcome: MatchOutcome
    shot_id: str
    """Empty when no swing made the launch."""
    launch: LaunchRecord | None
    reason: str
    """Why the launch is implausible; empty if it is not."""
    shot: Shot | None
    """Row of the swing, with all known values of club and ball."""


def reported_columns(launch: LaunchRecord) -> dict[str, Any]:
    """Return the columns of the shot table that `launch` knows; without spin the other columns."""
    known: dict[str, tuple[float | None, float]] = {
        "ball_speed_mps": (launch.speed, 1.0),
        "launch_angle_deg": (launch.launch_angle, degrees(1)),
        "direction_deg": (launch.direction, degrees(1)),
        "spin_rpm": (launch.spin, 30 / pi),
        "spin_axis_deg": (launch.spin_axis, degrees(1)),
    }
    if launch.carry is not None:
        known["carry_monitor_m"] = launch.carry, 1.0
    figures = {name: scale * value for name, (value, scale) in known.items() if value is not None}
    return {**figures, "launch_source": launch.source} if figures else {}


class ShotMatcher:
    """Matcher of swings and launches that are not settled yet."""

    def __init__(self, window: MatchWindow, plant: PlantParameters, around: FlightConditions) -> None:
        self._window, self._plant, self._around = window, plant, around
        self._swings: dict[str, tuple[int, datetime, FinishedSwing]] = {}
        self._open: tuple[SwingImpact, ...] = ()
        self._launches: tuple[LaunchRecord, ...] = ()
        self._clubs: list[ClubRecord] = []
        self._refused: list[RefusedRecord] = []
        self._matched: LaunchRecord | None = None
        """Launch of the last matched swing."""
        self._told: list[SettledOutcome] = []
        self.counts = dict.fromkeys(MatchOutcome, 0)
        """Outcomes so far."""
        self._number = 0

    def note_swing(self, swing: FinishedSwing, time_utc: datetime) -> None:
        """Take a swing that is over, at `time_utc`; one that did not reach the ball is settled at once."""
        self._number += 1
        if swing.impact is None:
            self._tell(Match(MatchOutcome.NO_LAUNCH, swing.shot, None), (self._number, time_utc, swing))
            return
        self._swings[swing.shot] = self._number, time_utc, swing
        self._open += (SwingImpact(swing.shot, swing.impact),)

    def note_launches(self, launches: list[LaunchRecord]) -> None:
        """Add the launches of the monitors."""
        self._launches = (*self._launches, *launches)

    def note_asides(self, asides: Iterable[ClubRecord | RefusedRecord]) -> None:
        """Add the monitors' clubs without a ball and refused messages."""
        for aside in asides:
            if isinstance(aside, ClubRecord):
                self._clubs.append(aside)
            else:
                self._refused.append(aside)

    @property
    def awaits_launch(self) -> bool:
        """Whether a ball was struck that no monitor has reported so far."""
        return bool(self._open) and not self._launches

    def settle(self, now: float, *, not_ready: bool = False) -> list[SettledOutcome]:
        """Return the outcomes that are settled at `now` (s, CLOCK_MONOTONIC).

        `not_ready`: a monitor reports itself not ready, which explains a launch that it did not report.
        """
        repeated = [one for one in self._launches if self._is_sent_again(one)]
        for launch in repeated:
            self._tell(Match(MatchOutcome.REPEATED, "", launch), None)
        self._launches = tuple(one for one in self._launches if one not in repeated)
        while len(self._launches) > _MAX_OPEN:  # too many to be swings of this bench
            self._tell(Match(MatchOutcome.NO_SWING, "", self._launches[0]), None)
            self._launches = self._launches[1:]
        launches, self._clubs = join_clubs(self._launches, self._clubs)
        found = match(self._open, launches, now, self._window)
        ordered = sorted(self._open, key=lambda swing: swing.time)
        self._open, self._launches = found.swings, found.launches
        swings = {one.shot: self._swings[one.shot] for one in found.decided if one.shot}
        for one in found.decided:
            self._tell(one, swings.get(one.shot), self._unseen(one.shot, ordered, not_ready=not_ready))
            if one.outcome is MatchOutcome.MATCHED:
                self._matched = one.launch
        for shot in swings:
            del self._swings[shot]
        self._forget(now)
        told, self._told = self._told, []
        return told

    def _is_sent_again(self, launch: LaunchRecord) -> bool:
        """Return whether `launch` is that of an earlier swing, by its number and figures."""
        before = self._matched
        if before is None or launch.number is None or launch.number != before.number:
            return False
        return launch.is_repeat_of(before)

    def _unseen(self, shot: str, ordered: Sequence[SwingImpact], *, not_ready: bool) -> str:
        """Return why no launch is known of `shot`, one of the `ordered` swings."""

        def of_shot(time: float) -> bool:
            owner = owner_of(time, ordered, self._window)
            return owner is not None and owner.shot == shot

        if refused := dict.fromkeys(one.reason for one in self._refused if of_shot(one.time)):
            return f"{REFUSED}: {'; '.join(refused)}"
        if any(of_shot(club.time) for club in self._clubs):
            return CLUB_ALONE
        return f"{UNREPORTED}: it reports itself not ready" if not_ready else UNREPORTED

    def _forget(self, now: float) -> None:
        """Drop clubs and refused messages whose swing must be settled by `now`."""
        first = now - self._window.latest - self._window.timeout
        self._clubs = [one for one in self._clubs if one.time > first][-_MAX_OPEN:]
        self._refused = [one for one in self._refused if one.time > first][-_MAX_OPEN:]

    def _tell(
        self, one: Match, of: tuple[int, datetime, FinishedSwing] | None, unseen: str = UNREPORTED
    ) -> None:
        self.counts[one.outcome] += 1
        if of is None or one.outcome not in (MatchOutcome.MATCHED, MatchOutcome.NO_LAUNCH):
            launch = None if one.launch is None else add_doubts(one.launch)
            self._told.append(SettledOutcome(one.outcome, one.shot, launch, str(one.outcome), None))
            return
        self._told.append(self._of_swing(one, *of, unseen))

    def _of_swing(
        self, one: Match, number: int, time_utc: datetime, swing: FinishedSwing, unseen: str
    ) -> SettledOutcome:
        """Return the outcome of a swing; `unseen` is the reason where a ball was struck and none reported."""
        plant, trips = self._plant, swing.cycles["cause"]
        delivery = delivery_of_cycles(swing.cycles, plant)
        launch = one.launch
        if launch is not None:
            launch = add_doubts(launch, None if delivery is None else delivery.speed)
            reason = "; ".join(filter(None, (one.reason, launch.reason)))
        else:
            reason = NO_IMPACT if swing.impact is None else unseen if swing.struck else NO_BALL
        flight: Flight | None = None
        if launch is not None and launch.launch is not None and not launch.doubts:
            try:
                flight = self._around.fly(launch.launch, REFERENCE_BALL)
            except ValueError as error:
                reason = reason or f"no flight: {error}"
        why, status = reason, ShotStatus.EXCLUDED if reason else ShotStatus.VALID
        if trips.any():
            why, status = CAUSE_TEXT[Cause(int(trips[trips != 0][0]))], ShotStatus.FAILED
        elif launch is None and not (swing.struck and swing.impact is not None):
            status = ShotStatus.FAILED
        columns = delivery_columns(delivery) | flight_columns(flight, "reference")
        columns |= {} if flight is None else {"carry_reference_m": flight.carry}
        columns |= {} if launch is None else reported_columns(launch)
        club, ball = plant.robot.club.name, "" if launch is None else plant.ball.name
        shot = Shot(number, 1, 1, club, ball, status, why, time_utc=time_utc, **columns)
        return SettledOutcome(one.outcome, one.shot, launch, reason, shot)
