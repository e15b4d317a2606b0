from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Callable
from dataclasses import fields, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.errors import BenchError
from bench.base.lifecycle import Cause, State
from bench.control.step_records import ControlState, new_control_state
from bench.loop.snapshot import SNAPSHOT, pack_snapshot, read_snapshot, unpack_snapshot
from bench.records.telemetry.swing_cutter import RecordSegment
from bench.records.telemetry.swing_metadata import (
    begin_of,
    profile_entry,
    read_profile,
    run_entries,
    since,
    snapshot_entry,
    swing_metadata,
)
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from tests.bench.swing.test_profile import FOLLOWED

MakeDay = Callable[..., np.ndarray[Any, Any]]
PLAN = [(State.READY, 100), (State.ARMED, 200), (State.SWINGING, 200), (State.FAULT, 100)]


@pytest.fixture
def profile() -> Profile:
    return load_profile(find_profile("default"))


def some_state(seed: int) -> ControlState:
    """Return a controller's memory with noise in every field, also between them."""
    random = np.random.default_rng(seed)
    state = new_control_state()
    for record in state:
        record.view(np.ndarray).view(np.uint8)[:] = random.integers(0, 2, record.itemsize)
    state.control["tick"], state.control["time"] = 150, 1000.125
    return state


def describe(cut: RecordSegment, **more: Any) -> dict[str, Any]:
    now = datetime(2026, 11, 21, 12, 0, 0, 123456, UTC)
    return swing_metadata(cut, {"run": "r"}, number=7, begin=begin_of(cut.cycles), time_utc=now, **more)


@given(st.floats(0, 1e9), st.lists(st.floats(0, 1e4), max_size=20), st.floats(-1.0, 0.0))
def test_since_restores_loop_times_bit_for_bit(first: float, later: list[float], age: float) -> None:
    cycles = np.zeros(1 + len(later), [("time", "f8"), ("encoder_time", "f8", (3,))])
    cycles["time"] = [first, *(first + x for x in sorted(later))]
    cycles["encoder_time"] = (cycles["time"] + age).clip(0)[:, None]
    begin = begin_of(cycles)
    stored = since(cycles, begin)
    assert 0.0 <= stored["time"][0] < 1 / 1024
    assert since(stored, -begin).tobytes() == cycles.tobytes()


def test_since_absent_encoder_times_stay_nan(make_day: MakeDay) -> None:
    cycles = make_day(PLAN)
    cycles["encoder_time"][5] = np.nan
    assert np.isnan(since(cycles, 1000.0)["encoder_time"][5]).all()


def test_swing_metadata_outcome_lists_states_and_first_cause(make_day: MakeDay) -> None:
    cycles = make_day(PLAN, cause=(400, Cause.WRIST_RANGE))
    cycles["cause"][450:] = Cause.GUARD
    metadata = describe(RecordSegment(cycles, "swing", 0))
    assert metadata["outcome"]["states"] == [[1, "READY"], [101, "ARMED"], [301, "SWINGING"], [501, "FAULT"]]
    assert metadata["outcome"]["cause"] == "WRIST_RANGE"
    assert "wrist outside its working range" in metadata["outcome"]["text"]
    assert metadata["complete"]
    assert metadata["time_utc"] == "2026-11-21T12:00:00.123456+00:00"
    json.dumps(metadata, allow_nan=False)


def test_swing_metadata_separates_lost_records_and_missed_ticks(make_day: MakeDay) -> None:
    cycles = make_day(PLAN)
    metadata = describe(RecordSegment(np.concatenate([cycles[:50], cycles[57:]]), "swing", 4))
    assert (metadata["lost_records"], metadata["missed_ticks"]) == (4, 3)
    assert not metadata["complete"]


def snapshot_at(tick: int) -> np.ndarray[Any, Any]:
    snapshot = np.zeros(1, SNAPSHOT)
    snapshot["tick"] = tick
    return snapshot


def test_swing_metadata_stores_first_snapshot_within_record(make_day: MakeDay) -> None:
    cycles = make_day(PLAN, first_tick=100)
    snapshots = [snapshot_at(t) for t in (99, 400, 200, 699, 5000)]
    metadata = describe(RecordSegment(cycles, "swing", 0), snapshots=snapshots)
    assert metadata["snapshot"]["tick"] == 200
    assert metadata["replayable"]
    assert not describe(RecordSegment(cycles, "swing", 3), snapshots=snapshots)["replayable"]
    for outside in (99, 699, 5000):
        metadata = describe(RecordSegment(cycles, "swing", 0), snapshots=[snapshot_at(outside)])
        assert metadata["snapshot"] is None
        assert not metadata["replayable"]


def assert_same_values(before: np.ndarray[Any, Any], after: np.ndarray[Any, Any]) -> None:
    """Compare all fields bit for bit, not the gaps between them."""
    for name in before.dtype.names or ():
        if before.dtype[name].names:
            assert_same_values(before[name], after[name])
        else:
            assert before[name].tobytes() == after[name].tobytes(), name


def test_read_snapshot_restores_control_state() -> None:
    state = some_state(1)
    snapshot = np.zeros(1, SNAPSHOT)
    pack_snapshot(state, snapshot)
    assert snapshot["tick"][0] == 150
    assert snapshot["time"][0] == 1000.125
    metadata = json.loads(json.dumps({"snapshot": snapshot_entry(snapshot)}))
    again = unpack_snapshot(read_snapshot(metadata, "x.parquet"))
    for before, after in zip(state, again, strict=True):
        assert_same_values(before, after)
    again.control["tick"] = 3
    assert snapshot["tick"][0] == 150


def test_read_snapshot_invalid_entry_is_refused() -> None:
    entry = snapshot_entry(snapshot_at(5))
    huge = base64.b64encode(zlib.compress(b"\0" * (SNAPSHOT.itemsize + 1))).decode()
    torn = base64.b64encode(base64.b64decode(entry["data"])[:-9]).decode()
    cases: list[tuple[Any, str]] = [
        (None, "found missing"),
        ("text", "found missing"),
        ({**entry, "layout": "0"}, "layout 0"),
        ({**entry, "data": "%"}, "not readable"),
        ({**entry, "data": 3}, "not readable"),
        ({**entry, "data": base64.b64encode(b"abc").decode()}, "not readable"),
        ({**entry, "data": huge}, "expected"),
        ({**entry, "data": torn}, "expected"),
        ({key: entry[key] for key in ("tick", "time", "layout")}, "not readable"),
    ]
    for bad, message in cases:
        with pytest.raises(BenchError, match=message):
            read_snapshot({"snapshot": bad}, "x.parquet")


def test_read_profile_restores_profile_bit_for_bit(profile: Profile) -> None:
    profile.angle[3, 1] += 1e-13  # more than its file would keep
    profile = replace(profile, followed=FOLLOWED)
    again = read_profile(json.loads(json.dumps({"profile": profile_entry(profile)})), "x.parquet")
    for field in fields(Profile):
        before, after = getattr(profile, field.name), getattr(again, field.name)
        assert type(before) is type(after)
        assert np.array_equal(before, after) if isinstance(before, np.ndarray) else before == after


def test_read_profile_invalid_entry_is_refused(profile: Profile) -> None:
    entry = profile_entry(profile)
    for bad in ({}, {"name": "x"}, {**entry, "data": "%"}, {**entry, "data": entry["data"][:400]}):
        with pytest.raises(BenchError, match="profile"):
            read_profile({"profile": bad}, "x.parquet")
    with pytest.raises(BenchError, match="profile"):
        read_profile({}, "x.parquet")


def test_run_metadata_entries_without_json_form_raise_error(profile: Profile) -> None:
    for bad in (float("nan"), object()):
        with pytest.raises(BenchError, match="metadata of records"):
            run_entries({"x": bad}, profile)
    entries = run_entries({"configuration": {"x": (1, 2)}, "calibrations": {"club": 1}}, profile)
    assert entries["configuration"] == {"x": [1, 2]}
    assert entries["profile"]["name"] == profile.name
