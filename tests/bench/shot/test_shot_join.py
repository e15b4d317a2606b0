from __future__ import annotations

from typing import Any

from bench.shot.shot_join import LONGEST_WAIT, ShotJoin


def outcome(shot: str | None) -> dict[str, Any]:
    return {"shot_id": shot, "outcome": "matched", "record": None}


def test_whichever_is_known_first_waits_for_the_other() -> None:
    join = ShotJoin()
    join.note_record("a", "/a")
    join.note_outcome(outcome("b"), 0.0)
    join.note_outcome(outcome("a"), 0.0)
    assert join.take(1.0) == [outcome("a") | {"record": "/a"}]
    assert join.take(1.1) == []
    join.note_record("b", "/b")
    assert join.take(1.2) == [outcome("b") | {"record": "/b"}]


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
        join.note_record(f"r{k}", "/r")
    assert len(join.take(0.0)) == 1000 - 64
    assert len(join._records) == 64
