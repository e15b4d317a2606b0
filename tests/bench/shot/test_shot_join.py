from __future__ import annotations

from bench.shot.shot_message import LONGEST_WAIT, ShotJoin, ShotPublication, shot_publication
from drivers.launch_monitor.matching import MatchOutcome


def outcome(shot: str | None, record: str | None = None, number: int | None = None) -> ShotPublication:
    return shot_publication(shot_id=shot, outcome=MatchOutcome.MATCHED, record=record, number=number)


def test_whichever_is_known_first_waits_for_the_other() -> None:
    join = ShotJoin()
    join.note_record("a", {"record": "/a", "number": 1})
    join.note_outcome(outcome("b"), 0.0)
    join.note_outcome(outcome("a"), 0.0)
    assert join.take(1.0) == [outcome("a", "/a", 1)]
    assert join.take(1.1) == []
    join.note_record("b", {"record": "/b", "number": 2})
    assert join.take(1.2) == [outcome("b", "/b", 2)]


def test_without_a_record_an_outcome_is_told_all_the_same() -> None:
    join = ShotJoin()
    join.note_outcome(outcome(None), 0.0)
    join.note_outcome(outcome("a"), 0.0)
    assert join.take(0.0) == [outcome(None)]  # no swing, no record
    assert join.take(LONGEST_WAIT) == []
    assert join.take(LONGEST_WAIT + 0.1) == [outcome("a")]


def test_what_is_kept_is_bounded() -> None:
    join = ShotJoin()
    for k in range(1000):
        join.note_outcome(outcome(str(k)), 0.0)
        join.note_record(f"r{k}", {"record": "/r"})
    assert len(join.take(0.0)) == 1000 - 64
    assert len(join._records) == 64
