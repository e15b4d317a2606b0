from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.errors import BenchError
from bench.records.shot.shot_message import (
    MAX_RECORD_WAIT,
    ShotJoin,
    ShotPublication,
    launch_from_json,
    launch_to_json,
    read_shot_message,
    shot_publication,
)
from drivers.launch_monitor.record import ClubFigures, LaunchRecord, MatchOutcome

FULL = LaunchRecord(
    12.5,
    "monitor",
    7,
    60.0,
    0.2,
    -0.01,
    300.0,
    0.02,
    None,
    ClubFigures(speed=42.0),
    (("carry", "not sent"),),
    ("ball speed 9 times the club's",),
)


MESSAGE = shot_publication(
    shot_id="r-1", record="/data/a.parquet", outcome=MatchOutcome.MATCHED, launch=launch_to_json(FULL)
)


def test_read_shot_message_restores_sent_message() -> None:
    read = read_shot_message(json.dumps(MESSAGE).encode())
    assert read == MESSAGE
    assert read["launch"] is not None
    assert launch_from_json(read["launch"]) == FULL


LAUNCH = launch_to_json(FULL)


@pytest.mark.parametrize(
    ("changes", "location", "found"),
    [
        ({"version": 2}, "", "b'"),
        ({"outcome": "won"}, ".outcome", '"won"'),
        ({"record": 3}, ".record", "3"),
        ({"shot_id": 5}, ".shot_id", "5"),
        ({"tick": True}, ".tick", "true"),
        ({"cause": "BOREDOM"}, ".cause", '"BOREDOM"'),
        ({"shot": {}}, ".shot.shot", "nothing"),
        ({"launch": []}, ".launch", "[]"),
        ({"launch": {**LAUNCH, "speed": "60"}}, ".launch.speed", '"60"'),
        ({"launch": {**LAUNCH, "speed": float("nan")}}, ".launch.speed", "NaN"),
        ({"launch": {**LAUNCH, "number": 1.5}}, ".launch.number", "1.5"),
        ({"launch": {**LAUNCH, "club": {"colour": 1.0}}}, ".launch.club.speed", "nothing"),
        ({"launch": {**LAUNCH, "absent": [["spin"]]}}, ".launch.absent[0]", '["spin"]'),
        ({"launch": {**LAUNCH, "doubts": "x"}}, ".launch.doubts", '"x"'),
        ({"launch": {name: v for name, v in LAUNCH.items() if name != "spin"}}, ".launch.spin", "nothing"),
    ],
)
def test_read_shot_message_invalid_value_reports_location(
    changes: dict[str, Any], location: str, found: str
) -> None:
    with pytest.raises(BenchError) as refused:
        read_shot_message(json.dumps({**MESSAGE, **changes}).encode())
    assert refused.value.location == f"shot message{location}"
    assert refused.value.found.startswith(found)


def test_read_shot_message_missing_key_is_refused() -> None:
    for name in MESSAGE.keys() - {"version"}:
        fewer = {key: value for key, value in MESSAGE.items() if key != name}
        with pytest.raises(BenchError, match=name):
            read_shot_message(json.dumps(fewer).encode())


def test_read_shot_message_deeply_nested_launch_is_refused() -> None:
    for depth in range(960, 1010):
        nested = "[" * depth + "]" * depth
        with pytest.raises(BenchError, match="shot message"):
            read_shot_message(json.dumps({**MESSAGE, "launch": 0}).replace(": 0", f": {nested}").encode())


@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode))
def test_read_shot_message_any_bytes_raise_bench_error(payload: bytes) -> None:
    with pytest.raises(BenchError):
        read_shot_message(payload)


def test_launch_to_json_truncates_long_reasons() -> None:
    long = LaunchRecord(1.0, "d" * 64, 1, doubts=("x" * 5000,), absent=(("speed", "y" * 5000),))
    told = launch_to_json(long)
    assert len(json.dumps(told)) < 1500
    assert launch_from_json(told).doubts[0].endswith("…")


def outcome(shot: str | None, record: str | None = None, number: int | None = None) -> ShotPublication:
    return shot_publication(shot_id=shot, outcome=MatchOutcome.MATCHED, record=record, number=number)


def test_shot_join_pairs_outcome_and_record_in_either_order() -> None:
    join = ShotJoin()
    join.note_record("a", {"record": "/a", "number": 1})
    join.note_outcome(outcome("b"), 0.0)
    join.note_outcome(outcome("a"), 0.0)
    assert join.take(1.0) == [outcome("a", "/a", 1)]
    assert join.take(1.1) == []
    join.note_record("b", {"record": "/b", "number": 2})
    assert join.take(1.2) == [outcome("b", "/b", 2)]


def test_shot_join_outcome_without_record_is_returned_after_wait() -> None:
    join = ShotJoin()
    join.note_outcome(outcome(None), 0.0)
    join.note_outcome(outcome("a"), 0.0)
    assert join.take(0.0) == [outcome(None)]  # no swing, no record
    assert join.take(MAX_RECORD_WAIT) == []
    assert join.take(MAX_RECORD_WAIT + 0.1) == [outcome("a")]


def test_shot_join_pending_entries_are_bounded() -> None:
    join = ShotJoin()
    for k in range(1000):
        join.note_outcome(outcome(str(k)), 0.0)
        join.note_record(f"r{k}", {"record": "/r"})
    assert len(join.take(0.0)) == 1000 - 64
    assert len(join._records) == 64
