from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.errors import BenchError
from bench.shot.shot_message import ShotMessage, launch_from_json, launch_to_json, read_shot_message
from drivers.launch_monitor.matching import MatchOutcome
from drivers.launch_monitor.record import ClubFigures, LaunchRecord

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


def message(**changes: Any) -> bytes:
    return json.dumps(
        {
            "version": 1,
            "shot_id": "r-1",
            "record": "/data/a.parquet",
            "shot": None,
            "outcome": "matched",
            "launch": launch_to_json(FULL),
            "reason": "",
            **changes,
        }
    ).encode()


def test_what_is_sent_is_read_again() -> None:
    read = read_shot_message(message())
    assert read == ShotMessage(
        "r-1", Path("/data/a.parquet"), None, None, "", None, MatchOutcome.MATCHED, FULL, ""
    )
    few = read_shot_message(b'{"version": 1, "record": "x"}')  # of a bench without a launch monitor
    assert few == ShotMessage("", Path("x"), None, None, "", None, None, None, "")


@pytest.mark.parametrize(
    "changes",
    [
        {"version": 2},
        {"outcome": "won"},
        {"record": 3},
        {"shot_id": 5},
        {"launch": []},
        {"launch": {**launch_to_json(FULL), "speed": "60"}},
        {"launch": {**launch_to_json(FULL), "speed": float("nan")}},
        {"launch": {**launch_to_json(FULL), "number": 1.5}},
        {"launch": {**launch_to_json(FULL), "club": {"colour": 1.0}}},
        {"launch": {**launch_to_json(FULL), "absent": [["spin"]]}},
        {"launch": {name: v for name, v in launch_to_json(FULL).items() if name != "spin"}},
    ],
)
def test_what_is_no_shot_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(BenchError, match="shot"):
        read_shot_message(message(**changes))


@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode))
def test_nothing_but_a_bench_error_comes_of_any_bytes(payload: bytes) -> None:
    with pytest.raises(BenchError):
        read_shot_message(payload)


def test_long_reasons_are_cut_a_pipe_takes_no_more() -> None:
    long = LaunchRecord(1.0, "d" * 64, 1, doubts=("x" * 5000,), absent=(("speed", "y" * 5000),))
    told = launch_to_json(long)
    assert len(json.dumps(told)) < 1500
    assert launch_from_json(told, "here").doubts[0].endswith("…")
