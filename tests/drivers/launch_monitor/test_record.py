from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.launch_monitor.record import (
    ClubFigures,
    ClubRecord,
    LaunchRecord,
    Match,
    MatchOutcome,
    MatchWindow,
    SwingImpact,
    join_clubs,
    match,
)

WINDOW = MatchWindow(latest=5.0, timeout=10.0)


def told(time: float, number: int = 1, speed: float = 60.0) -> LaunchRecord:
    return LaunchRecord(time, "monitor", number, speed=speed)


def outcomes(
    swings: list[SwingImpact], launches: list[LaunchRecord], now: float = 1e3
) -> list[tuple[str, str]]:
    return [(m.outcome.name, m.shot) for m in match(swings, launches, now, WINDOW).decided]


def test_match_swing_and_launch_are_matched() -> None:
    swing, launch = SwingImpact("7", 100.0), told(101.0)
    (found,) = match([swing], [launch], 200.0, WINDOW).decided
    assert (found.outcome, found.shot, found.launch, found.reason) == (MatchOutcome.MATCHED, "7", launch, "")


@pytest.mark.parametrize("delay", [-0.1, 0.0, 5.0])
def test_match_window_ends_are_inclusive(delay: float) -> None:
    assert outcomes([SwingImpact("7", 100.0)], [told(100.0 + delay)]) == [("MATCHED", "7")]


@pytest.mark.parametrize("delay", [-0.101, 5.001])
def test_match_outside_window_reports_no_launch_and_no_swing(delay: float) -> None:
    found = outcomes([SwingImpact("7", 100.0)], [told(100.0 + delay)])
    assert sorted(found) == [("NO_LAUNCH", "7"), ("NO_SWING", "")]


def test_match_decides_only_after_window_or_timeout() -> None:
    swing, launch, stray = SwingImpact("7", 100.0), told(101.0), told(80.0)
    early = match([swing], [launch, stray], 89.0, WINDOW)
    assert early.decided == ()
    assert (early.swings, set(early.launches)) == ((swing,), {launch, stray})
    later = match(early.swings, early.launches, 104.9, WINDOW)
    assert [m.outcome for m in later.decided] == [MatchOutcome.NO_SWING]
    last = match(later.swings, later.launches, 105.1, WINDOW)
    assert [m.outcome for m in last.decided] == [MatchOutcome.MATCHED]
    assert (last.swings, last.launches) == ((), ())


def test_match_same_launch_again_is_repeated() -> None:
    assert outcomes([SwingImpact("7", 100.0)], [told(101.0), told(103.0)]) == [
        ("MATCHED", "7"),
        ("REPEATED", "7"),
    ]


def test_match_different_second_launch_is_double() -> None:
    decided = match([SwingImpact("7", 100.0)], [told(101.0), told(101.2, 2, 61.0)], 200.0, WINDOW).decided
    assert [m.outcome for m in decided] == [MatchOutcome.MATCHED, MatchOutcome.DOUBLE]
    assert "2 different launches" in decided[0].reason


CLUB = ClubFigures(speed=43.0, path=0.01)


@pytest.mark.parametrize("delay", [-3.0, 0.4, 3.0])
def test_join_clubs_same_device_joins_launch(delay: float) -> None:
    club = ClubRecord(101.0 + delay, "monitor", CLUB, (("club.attack_angle", "no AngleOfAttack"),))
    (joined,), alone = join_clubs([told(101.0)], [club])
    assert (joined.club, joined.absent, alone) == (CLUB, club.absent, [])
    assert (joined.time, joined.speed) == (101.0, 60.0)


@pytest.mark.parametrize(("delay", "device"), [(3.01, "monitor"), (-3.01, "monitor"), (0.1, "another")])
def test_join_clubs_other_time_or_device_stays_unjoined(delay: float, device: str) -> None:
    club = ClubRecord(101.0 + delay, device, CLUB)
    assert join_clubs([told(101.0)], [club]) == ([told(101.0)], [club])


def test_join_clubs_picks_nearest_launch_without_club() -> None:
    clubs = [ClubRecord(104.1, "monitor", CLUB), ClubRecord(102.0, "monitor", CLUB._replace(speed=44.0))]
    joined, alone = join_clubs([told(101.0), told(104.0, 2)], clubs)
    assert ([one.club.speed for one in joined], alone) == ([44.0, 43.0], [])


def test_join_clubs_launch_keeps_own_figures() -> None:
    own = replace(told(101.0), club=ClubFigures(speed=44.0))
    (joined,), _ = join_clubs([own], [ClubRecord(101.1, "monitor", CLUB)])
    assert joined.club == ClubFigures(speed=44.0, path=0.01)


@pytest.mark.parametrize("number", [1, 2])
def test_match_same_ball_with_and_without_club_is_repeated(number: int) -> None:
    both = [told(101.0), replace(told(101.4, number), club=CLUB)]
    for launches in (both, [replace(both[1], time=101.0), replace(both[0], time=101.4)]):
        first, second = match([SwingImpact("7", 100.0)], launches, 200.0, WINDOW).decided
        assert (first.outcome, first.reason) == (MatchOutcome.MATCHED, "")
        assert second.outcome is MatchOutcome.REPEATED
        assert first.launch is not None
        assert first.launch.club == CLUB


def test_match_window_ends_at_next_swing() -> None:
    swings = [SwingImpact("7", 100.0), SwingImpact("8", 103.0)]
    assert outcomes(swings, [told(103.5)]) == [("NO_LAUNCH", "7"), ("MATCHED", "8")]
    assert outcomes(swings, [told(102.0), told(103.5)]) == [("MATCHED", "7"), ("MATCHED", "8")]
    assert [m.shot for m in match(swings, [], 103.0, WINDOW).decided] == ["7"]


def test_match_duplicate_swing_id_raises() -> None:
    with pytest.raises(ValueError, match="the same id"):
        match([SwingImpact("7", 1.0), SwingImpact("7", 2.0)], [], 3.0, WINDOW)


TIMES = st.floats(0.0, 60.0)


@given(st.lists(TIMES, max_size=8), st.lists(st.tuples(TIMES, st.integers(0, 2)), max_size=12), st.data())
def test_match_gives_each_swing_and_launch_single_outcome(
    impacts: list[float], messages: list[tuple[float, int]], data: st.DataObject
) -> None:
    swings = [SwingImpact(str(n), time) for n, time in enumerate(impacts)]
    launches = [told(time, number) for time, number in messages]
    decided = match(swings, launches, 1e3, WINDOW)
    assert (decided.swings, decided.launches) == ((), ())
    of_swings = [
        m.shot for m in decided.decided if m.outcome in (MatchOutcome.MATCHED, MatchOutcome.NO_LAUNCH)
    ]
    assert sorted(of_swings) == sorted(swing.shot for swing in swings)
    of_launches = [m.launch for m in decided.decided if m.launch is not None]
    assert sorted(map(id, of_launches)) == sorted(map(id, launches))
    # Asked in between, as messages come, it says the same.
    swings_left: list[SwingImpact] = []
    launches_left: list[LaunchRecord] = []
    stepwise: list[Match] = []
    for now in sorted(data.draw(st.lists(TIMES, max_size=4))) + [1e3]:
        known = {id(launch) for launch in of_launches if launch.time <= now}
        fresh = [launch for launch in launches if id(launch) in known]
        launches = [launch for launch in launches if id(launch) not in known]
        swings_left += [swing for swing in swings if swing.time <= now]
        swings = [swing for swing in swings if swing.time > now]
        step = match(swings_left, [*launches_left, *fresh], now, WINDOW)
        swings_left, launches_left = list(step.swings), list(step.launches)
        stepwise += step.decided
    assert {(m.outcome, m.shot, id(m.launch)) for m in stepwise} == {
        (m.outcome, m.shot, id(m.launch)) for m in decided.decided
    }


WHOLE = replace(told(101.0), launch_angle=0.2, direction=0.01, spin=260.0, spin_axis=0.1)


@pytest.mark.parametrize(
    ("first", "later"),
    [
        (replace(WHOLE, spin=None, spin_axis=None, absent=(("spin", "0 rpm: not measured"),)), WHOLE),
        (WHOLE, replace(WHOLE, carry=210.0, club=CLUB)),
        (WHOLE, replace(WHOLE, number=2)),
    ],
    ids=["spin later", "carry and club later", "renumbered"],
)
def test_match_completed_or_renumbered_ball_is_one_launch(first: LaunchRecord, later: LaunchRecord) -> None:
    decided = match([SwingImpact("7", 100.0)], [first, replace(later, time=102.0)], 200.0, WINDOW).decided
    assert [one.outcome for one in decided] == [MatchOutcome.MATCHED, MatchOutcome.REPEATED]
    launch = decided[0].launch
    assert launch is not None
    assert (launch.valid, launch.time, launch.number) == (True, 101.0, 1)
    assert (launch.carry, launch.club, launch.spin) == (later.carry, later.club, 260.0)


def test_match_other_number_and_unknown_figures_are_double() -> None:
    launches = [replace(WHOLE, spin=None), replace(WHOLE, number=2, time=102.0)]
    decided = match([SwingImpact("7", 100.0)], launches, 200.0, WINDOW).decided
    assert decided[1].outcome is MatchOutcome.DOUBLE
