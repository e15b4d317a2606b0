from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from math import radians
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import CAUSE_TEXT, Cause, Phase, State
from bench.records.shot.recorded_shot import FlightConditions
from bench.records.shot.shot import ShotStatus
from bench.records.shot.shot_matcher import (
    CLUB_ALONE,
    NO_BALL,
    NO_IMPACT,
    REFUSED,
    UNREPORTED,
    FinishedSwing,
    SettledOutcome,
    ShotMatcher,
    SwingWatch,
)
from bench.records.telemetry.swing_metadata import shot_id
from drivers.launch_monitor.record import (
    ClubFigures,
    ClubRecord,
    LaunchRecord,
    MatchOutcome,
    MatchWindow,
    RefusedRecord,
)
from sim.plant import PlantParameters, Site
from tests.bench.conftest import BALL

Cycles = np.ndarray[Any, Any]


@pytest.fixture
def day(make_swing: Any) -> Cycles:
    """Return a swing with a ball between two rests, its ticks from 5000 and times from 0 on, 1 kHz."""
    cycles: Cycles = make_swing(1)
    cycles["state"] = State.SWINGING
    cycles["state"][:200], cycles["state"][-100:] = State.ARMED, State.RECOVERING
    cycles["cause"] = 0
    return cycles


def watched(watch: SwingWatch, cycles: Cycles, piece: int, *, behind: float) -> list[FinishedSwing]:
    """Return the swings seen in pieces, each read when its last cycle is `behind` on the wall's clock."""
    found = []
    for k in range(0, len(cycles), piece):
        part = cycles[k : k + piece]
        found += watch.take(part, float(part["time"][-1]) + behind)
    return found


@pytest.mark.parametrize("piece", [1, 7, 20, 5000])
def test_swing_watch_returns_swing_with_id_impact_and_cycles(day: Cycles, piece: int) -> None:
    gone = day["time"][np.flatnonzero(day["ball_present"])[-1] + 1]
    for wall, behind in ((True, 0.004), (False, 4000.0)):
        (swing,) = watched(SwingWatch("run", wall=wall), day, piece, behind=behind)
        assert swing.shot == shot_id("run", 5200)
        assert swing.struck
        assert swing.impact == pytest.approx(gone + (0.0 if wall else behind), abs=1e-9)
        assert len(swing.cycles) == len(day) - 300 + 1  # and the one that ended it
        assert swing.cycles.tobytes() == day[200:-99].tobytes()


def test_swing_watch_lock_step_impact_follows_clock_slip(day: Cycles) -> None:
    watch, slipped = SwingWatch("run", wall=False), 0.0
    at = int(np.flatnonzero(day["ball_present"])[-1]) + 1
    found = []
    for k in range(0, len(day), 10):
        slipped += 0.03 if k == 700 else 0.0  # the machine stood still before the impact
        part = day[k : k + 10]
        found += watch.take(part, 100.0 + slipped + float(part["time"][-1]))
    (swing,) = found
    assert swing.impact == pytest.approx(100.03 + day["time"][at], abs=1e-9)


def test_swing_watch_swing_without_ball_or_stopped_is_not_struck(day: Cycles) -> None:
    empty = day.copy()
    empty["ball_present"] = False
    (swing,) = watched(SwingWatch("run", wall=True), empty, 50, behind=0.0)
    assert not swing.struck
    assert swing.impact == empty["time"][np.flatnonzero(empty["phase"] == Phase.IMPACT)[0]]

    stopped = day[:900].copy()
    stopped["ball_present"] = True
    stopped["state"][800:], stopped["cause"][800:] = State.FAULT, Cause.OPERATOR_STOP
    stopped["phase"][800:] = Phase.STANDING
    (swing,) = watched(SwingWatch("run", wall=True), stopped, 50, behind=0.0)
    assert (swing.impact, swing.struck) == (None, False)
    assert swing.cycles["cause"][-1] == Cause.OPERATOR_STOP


def test_swing_watch_swing_without_start_is_omitted(day: Cycles) -> None:
    assert watched(SwingWatch("run", wall=True), day[300:], 50, behind=0.0) == []
    watch = SwingWatch("run", wall=True)
    watch.take(day[:400], 0.4)
    assert watch.take(day[500:], 2.0, lost=True) == []
    assert len(watched(watch, day, 50, behind=0.0)) == 1  # the next one is whole again


NOW = datetime(2026, 11, 21, 19, 0, tzinfo=UTC)
WINDOW = MatchWindow(latest=4.0, timeout=10.0)


def launch(time: float, speed: float = 52.0, **changes: Any) -> LaunchRecord:
    given = {"launch_angle": 0.2, "direction": 0.01, "spin": 300.0, "spin_axis": 0.02, **changes}
    return LaunchRecord(time=time, device="monitor", number=1, speed=speed, **given)


@pytest.fixture
def book(robot: Any) -> ShotMatcher:
    site = replace(Site(), ball_x=BALL[0], ball_y=BALL[1])
    return ShotMatcher(WINDOW, PlantParameters(robot=robot, site=site), FlightConditions())


@pytest.fixture
def swing(make_swing: Any) -> FinishedSwing:
    cycles = make_swing(1)
    cycles["cause"] = 0
    return FinishedSwing("r-5000", 100.0, True, cycles)


def one(told: list[SettledOutcome]) -> SettledOutcome:
    (found,) = told
    return found


def test_shot_matcher_launch_in_window_is_matched(book: ShotMatcher, swing: FinishedSwing) -> None:
    book.note_launches([launch(100.7)])  # told before the robot stands again
    assert book.settle(100.8) == []
    book.note_swing(swing, NOW)
    assert book.settle(103.9) == []
    told = one(book.settle(104.1))
    assert (told.outcome, told.shot_id, told.reason) == (MatchOutcome.MATCHED, "r-5000", "")
    shot = told.shot
    assert shot is not None
    assert (shot.status, shot.launch_source, shot.carry_source) == (
        ShotStatus.VALID,
        "launch monitor",
        "reference",
    )
    assert (shot.ball_speed_mps, shot.delivery_source) == (52.0, "encoders+model")
    assert 120.0 < (shot.carry_m or 0.0) < 200.0
    assert shot.time_utc == NOW
    assert book.settle(200.0) == []  # told once


def test_shot_matcher_missing_launch_reason_names_cause(book: ShotMatcher, swing: FinishedSwing) -> None:
    book.note_swing(swing, NOW)
    book.note_swing(swing._replace(shot="r-6000", impact=110.0, struck=False), NOW)
    stopped = swing.cycles.copy()
    stopped["cause"][-1] = Cause.OPERATOR_STOP
    book.note_swing(swing._replace(shot="r-7000", impact=None, struck=False, cycles=stopped), NOW)
    told = {each.shot_id: each for each in book.settle(120.0)}
    assert {each.outcome for each in told.values()} == {MatchOutcome.NO_LAUNCH}
    assert [told[f"r-{n}000"].reason for n in (5, 6, 7)] == [UNREPORTED, NO_BALL, NO_IMPACT]
    shots = [told[f"r-{n}000"].shot for n in (5, 6, 7)]
    assert [shot and shot.status for shot in shots] == [
        ShotStatus.EXCLUDED,
        ShotStatus.FAILED,
        ShotStatus.FAILED,
    ]
    assert shots[2] is not None
    assert shots[2].reason == CAUSE_TEXT[Cause.OPERATOR_STOP]
    assert all(shot is not None and shot.ball_speed_mps is None for shot in shots)


def test_shot_matcher_unmatched_or_late_launch_is_no_swing(book: ShotMatcher, swing: FinishedSwing) -> None:
    book.note_launches([launch(50.0)])
    assert one(book.settle(61.0)).outcome is MatchOutcome.NO_SWING
    book.note_swing(swing, NOW)
    assert one(book.settle(104.1)).outcome is MatchOutcome.NO_LAUNCH
    book.note_launches([launch(104.5)])  # the window is over
    late = one(book.settle(115.0))
    assert (late.outcome, late.shot_id, late.shot) == (MatchOutcome.NO_SWING, "", None)
    assert book.counts[MatchOutcome.NO_SWING] == 2


def test_shot_matcher_two_different_launches_exclude_shot(book: ShotMatcher, swing: FinishedSwing) -> None:
    book.note_swing(swing, NOW)
    book.note_launches([launch(100.5), replace(launch(100.9, 52.5), device="another")])
    first, second = book.settle(105.0)
    assert (first.outcome, second.outcome) == (MatchOutcome.MATCHED, MatchOutcome.DOUBLE)
    assert first.shot is not None
    assert first.shot.status is ShotStatus.EXCLUDED
    assert "2 different launches" in first.reason
    assert second.shot is None  # one row a swing


def test_shot_matcher_misread_launch_is_kept_but_excluded(book: ShotMatcher, swing: FinishedSwing) -> None:
    book.note_swing(swing, NOW)
    book.note_launches([launch(100.5, 95.0)])  # more than twice the club's speed
    told = one(book.settle(105.0))
    assert told.outcome is MatchOutcome.MATCHED
    assert "times the club's" in told.reason
    assert told.shot is not None
    assert (told.shot.status, told.shot.ball_speed_mps, told.shot.carry_m) == (
        ShotStatus.EXCLUDED,
        95.0,
        None,
    )

    book.note_swing(swing._replace(shot="r-9", impact=200.0), NOW)
    no_spin = launch(200.5, spin=None, spin_axis=None, absent=(("spin", "0 rpm: not seen"),))
    book.note_launches([no_spin])
    told = one(book.settle(205.0))
    assert "no spin" in told.reason
    assert told.shot is not None
    assert (told.shot.ball_speed_mps, told.shot.status) == (52.0, ShotStatus.EXCLUDED)
    assert told.shot.launch_angle_deg == pytest.approx(np.degrees(0.2))
    assert told.shot.spin_rpm is None
    assert told.shot.direction_deg == pytest.approx(np.degrees(0.01))


@pytest.mark.parametrize(("time", "hears"), [(100.4, True), (104.1, False), (99.8, False)])
def test_shot_matcher_refused_message_in_window_becomes_reason(
    book: ShotMatcher, swing: FinishedSwing, time: float, hears: bool
) -> None:
    book.note_asides([RefusedRecord(time, "no JSON"), RefusedRecord(time, "no JSON")])
    book.note_swing(swing, NOW)
    told = one(book.settle(110.0))
    reason = f"{REFUSED}: no JSON" if hears else UNREPORTED
    assert told.shot is not None
    assert (told.reason, told.shot.reason, told.shot.status) == (reason, reason, ShotStatus.EXCLUDED)


def test_shot_matcher_club_record_without_ball_becomes_reason(
    book: ShotMatcher, swing: FinishedSwing
) -> None:
    book.note_swing(swing, NOW)
    book.note_asides([ClubRecord(100.4, "monitor", ClubFigures(speed=36.0))])
    told = one(book.settle(105.0))
    assert (told.outcome, told.reason) == (MatchOutcome.NO_LAUNCH, CLUB_ALONE)
    assert book.settle(300.0) == []  # and nothing else comes of it


def test_shot_matcher_launch_flood_is_bounded_and_counted(book: ShotMatcher) -> None:
    book.note_launches([launch(10.0 + 1e-3 * k, launch_angle=radians(10)) for k in range(1000)])
    assert len(book.settle(10.1)) == 1000 - 64
    assert len(book.settle(30.0)) == 64
    assert book.counts[MatchOutcome.NO_SWING] == 1000


def test_shot_matcher_launch_of_earlier_swing_sent_again_is_repeated(
    book: ShotMatcher, swing: FinishedSwing
) -> None:
    book.note_swing(swing, NOW)
    book.note_launches([launch(100.5)])
    assert one(book.settle(105.0)).outcome is MatchOutcome.MATCHED
    book.note_swing(swing._replace(shot="r-6000", impact=110.0), NOW)
    assert book.awaits_launch
    book.note_launches([launch(110.4), replace(launch(111.0, 52.1), number=2)])
    again, told = book.settle(120.0)
    assert (again.outcome, again.shot_id) == (MatchOutcome.REPEATED, "")
    assert (told.outcome, told.shot_id, told.reason) == (MatchOutcome.MATCHED, "r-6000", "")
    assert told.launch is not None
    assert told.launch.speed == 52.1


def test_shot_matcher_monitor_not_ready_is_reason(book: ShotMatcher, swing: FinishedSwing) -> None:
    book.note_swing(swing, NOW)
    assert one(book.settle(110.0, not_ready=True)).reason == f"{UNREPORTED}: it reports itself not ready"
