"""JSON metadata of a record of the daemon: its keys.

In addition to `schema_version` and `enumerations` (`bench.records.telemetry.record_file`):

`kind`           "swing"; "stop", a stop or fault without a swing
`bench`          id of the bench
`run`            id of the bench's run, from its start on
`number`         number of the record in it
`shot_id`        id of the swing's shot, null without the beginning of a swing
`time_utc`       first cycle, ISO 8601; names the file
`begin`          s; the loop's time is the columns `time` and `encoder_time` + `begin`, exactly: `begin` is
                 the first cycle's time rounded down to 1/1024 s, so neither sum nor difference rounds
`complete`       true when every tick's record from first to last is there and the robot stood at the end
`lost_records`   records the ring lost inside
`missed_ticks`   ticks that the loop itself skipped inside
`continued`      the robot moved already at its start: the previous record was cut there, or no recorder ran
`outcome`        `states`: [tick, name] at the first cycle and at each change; `cause`, `text`: first cause
                 of a stop; `then_found`: names of those found after it; `ended`: why the record ends before
                 the robot stood, else empty
`configuration`, `versions`, `real_time`, `calibrations`   as the supervisor gave them
`profile`        `name`, `golfer`, `club`, `impact_time`, and `data`: all of the profile, see `profile_entry`
                 `correction`, if a learned one was applied, which is in `data`: `number`, `weights`
`snapshot`       null, or the controller's memory after the step of `tick` (which is in the record) at the
                 loop's `time`: `layout`, digest of its type; `data`, base64 of zlib of its bytes
`replayable`     there is a snapshot, and no record is lost
`loop`           counters of the loop since the record before it, else null or missing: `ticks`, `skipped`,
                 `late`, `page_faults`, `preemptions`, and `stalls` by why (`preemption`, `page_fault`,
                 `long_tick`, `machine`: stolen time, interrupts)
`drift`          of a whole swing through the ball's place, else null or missing: `club_speed_mps`;
                 `ball_met_m`, where the encoders saw the head at the strike, along the ground; the medians of
                 the first swings with the same tables; `warnings`; see `bench.records.shot.strike`
"""

from __future__ import annotations

import base64
import json
import platform
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import fields
from datetime import UTC, datetime
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from math import floor
from typing import Any

import numpy as np

from bench.base.errors import BenchError
from bench.base.lifecycle import CAUSE_TEXT, MOVING, Cause, State
from bench.records.telemetry.swing_cutter import Cycles, RecordSegment
from bench.swing.profile import Profile

_GRID = 1024
"""`begin` is a multiple of its inverse, s."""
_MAX_PROFILE_BYTES = 64 << 20
"""Bytes of a profile's JSON."""


def versions() -> dict[str, str]:
    """Return the versions stored with every record."""
    names = ("golfbench", "numpy", "numba", "scipy")
    return {name: version(name) for name in names} | {"python": platform.python_version()}


def run_entries(run: Mapping[str, Any], profile: Profile) -> dict[str, Any]:
    """Return the keys of the metadata that all records of one run share: those of `run`, and the profile.

    Raises:
        BenchError: a value cannot be written as JSON, for example NaN.
    """
    try:
        text = json.dumps({**run, "profile": profile_entry(profile)}, allow_nan=False)
    except (TypeError, ValueError) as error:
        location, expected = "metadata of records", "values that JSON can hold, no NaN"
        raise BenchError(location, str(error), expected, "Report this error with the record.") from error
    entries: dict[str, Any] = json.loads(text)
    return entries


def swing_metadata(
    cut: RecordSegment,
    entries: Mapping[str, Any],
    *,
    number: int,
    begin: float,
    time_utc: datetime,
    snapshots: Iterable[np.ndarray[Any, Any]] = (),
) -> dict[str, Any]:
    """Return the metadata of record `number` with the cycles of `cut` (loop's times, at least one).

    `entries` are those of `run_entries`; of `snapshots` (one-element arrays with `tick` and `time`) the first
    that the record can be replayed from is stored.
    """
    cycles = cut.cycles
    ticks = cycles["tick"]
    missing = int(ticks[-1] - ticks[0]) + 1 - len(cycles)
    within = sorted(
        (s for s in snapshots if ticks[0] <= s["tick"][0] < ticks[-1]), key=lambda s: int(s["tick"][0])
    )
    snapshot = within[0] if within else None
    outcome = _outcome(cut)
    begun = [tick for tick, state in outcome["states"][1:] if state == State.SWINGING.name]
    return {
        **entries,
        "kind": cut.kind,
        "number": number,
        "shot_id": shot_id(entries["run"], begun[0]) if begun else None,
        "time_utc": time_utc.astimezone(UTC).isoformat(timespec="microseconds"),
        "begin": begin,
        "complete": not cut.lost and not cut.ended and not cut.continued,
        "lost_records": cut.lost,
        "missed_ticks": max(0, missing - cut.lost),
        "continued": cut.continued,
        "outcome": outcome,
        "snapshot": None if snapshot is None else snapshot_entry(snapshot),
        "replayable": snapshot is not None and not cut.lost,
    }


def begin_of(cycles: Cycles) -> float:
    """Return the time that is subtracted from the times of `cycles`, s."""
    return floor(float(cycles["time"][0]) * _GRID) / _GRID


def since(cycles: Cycles, begin: float) -> Cycles:
    """Return a copy of `cycles` with times from `begin` (s) on; -`begin` gives the loop's times back."""
    moved: Cycles = np.frombuffer(bytearray(cycles.view(np.uint8)), cycles.dtype)
    subtract_begin(moved, begin)
    return moved


def subtract_begin(cycles: Cycles, begin: float) -> None:
    """Let the times of `cycles` count from `begin` (s) on."""
    cycles["time"] -= begin
    cycles["encoder_time"] -= begin


def _outcome(cut: RecordSegment) -> dict[str, Any]:
    states, trips = cut.cycles["state"], cut.cycles["cause"]
    changes = [0, *(np.flatnonzero(np.diff(states)) + 1)]
    tripped = np.flatnonzero((trips != 0) & np.isin(states, list(MOVING)))
    cause = Cause(int(trips[tripped[0]])) if len(tripped) else Cause.NONE
    return {
        "states": [[int(cut.cycles["tick"][i]), State(int(states[i])).name] for i in changes],
        "cause": cause.name,
        "text": CAUSE_TEXT[cause],
        "then_found": [Cause(int(code)).name for code in _later(cut.cycles["latest_cause"], cause)],
        "ended": cut.ended,
    }


def _later(latest: np.ndarray[Any, Any], first: Cause) -> list[int]:
    """Return the causes found after the `first` in order, each once."""
    codes, at = np.unique(latest, return_index=True)
    return [int(code) for code in codes[np.argsort(at)] if code not in (Cause.NONE, first)]


def snapshot_entry(snapshot: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return `snapshot` (one element) for the metadata; `bench.loop.snapshot` reads it back."""
    return {
        "tick": int(snapshot["tick"][0]),
        "time": float(snapshot["time"][0]),
        "layout": layout_of(snapshot.dtype),
        "data": base64.b64encode(zlib.compress(snapshot.tobytes(), 1)).decode(),
    }


@cache
def layout_of(dtype: np.dtype[Any]) -> str:
    """Return a digest of names, types and places of all fields of `dtype`."""
    return sha256(f"{dtype.itemsize} {dtype.descr}".encode()).hexdigest()[:16]


def profile_entry(profile: Profile) -> dict[str, Any]:
    """Return `profile` for the metadata: the keys that people search, and `data`, base64 of zlib of its JSON.

    JSON keeps every bit of a number, the profile's TOML file rounds.
    """
    values = {field.name: getattr(profile, field.name) for field in fields(profile)}
    text = json.dumps(
        {key: v.tolist() if isinstance(v, np.ndarray) else v for key, v in values.items()}, allow_nan=False
    )
    return {
        "name": profile.name,
        "golfer": profile.golfer,
        "club": profile.club,
        "impact_time": profile.impact_time,
        "data": base64.b64encode(zlib.compress(text.encode(), 9)).decode(),
    }


def read_profile(metadata: Mapping[str, Any], location: str) -> Profile:
    """Return the profile in a record's `metadata`, bit for bit.

    Raises:
        BenchError: the profile is missing or damaged; `location` is the record's path.
    """
    try:
        packed = base64.b64decode(metadata["profile"]["data"], validate=True)
        values = json.loads(zlib.decompressobj().decompress(packed, _MAX_PROFILE_BYTES))
        arrays = {
            key: np.array(values[key], dtype=float) for key in ("angle", "velocity", "valve", "blind_brake")
        }
        pairs = {key: tuple(values[key]) for key in ("begins", "ball", "air")}
        return Profile(**{**values, **arrays, **pairs})
    except (KeyError, TypeError, ValueError, zlib.error) as error:
        found, expected = f"not readable: {error!r}", "the profile's data"
        action = "Replay a record that the daemon wrote, or restore it from a copy."
        raise BenchError(f"{location}: profile", found, expected, action) from error


def run_id(start: datetime) -> str:
    """Return the id of a bench's run from `start` on; ticks count from there."""
    return f"{start.astimezone(UTC):%Y%m%dT%H%M%SZ}"


def shot_id(run: str, tick: int) -> str:
    """Return the id of the shot whose swing began at `tick` of `run`."""
    return f"{run}-{tick}"
