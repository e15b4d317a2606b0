"""Memory of the controller at one tick, from which a replay starts.

The loop puts a snapshot into shared memory in each tick that accepts a request to move (home, arm, swing),
after the step; a replay of the record sets it and goes on with the tick after it. In a record's metadata it
stands as text, see `bench.telemetry.swing_metadata.snapshot_entry`.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from bench.control.air import AIR_STATE
from bench.control.encoder import ENCODER_STATE
from bench.control.estimator import ESTIMATOR_STATE
from bench.control.model import MODEL_STATE
from bench.control.pid import PID_STATE
from bench.control.records import CONTROL_STATE, ControlState, new_control_state
from bench.errors import BenchError
from bench.telemetry.swing_metadata import layout_of
from drivers.base.compiled import new_record

SNAPSHOT = np.dtype(
    [
        ("tick", "i8"),
        ("time", "f8"),
        ("control", CONTROL_STATE),
        ("encoder", ENCODER_STATE),
        ("estimator", ESTIMATOR_STATE),
        ("pid", PID_STATE),
        ("model", MODEL_STATE),
        ("air", AIR_STATE),
    ],
    align=True,
)
"""A ControlState after the step of `tick` at `time` (s, the loop's)."""

_KEPT = ("control", "encoder", "estimator", "pid", "model", "air")

_HOMING = ("home_begun", "home_free", "home_way", "home_touching", "home_pushed", "home_at")
_ANSWERS = ("answered", "answer_way", "answer_from", "answer_bound")
_ADDED: Mapping[str, frozenset[str]] = {
    "control": frozenset(
        {
            "stopped_at",
            "moved_at",
            "calm",
            *_HOMING,
            *_ANSWERS,
            "unseen",
            "entered",
            "sensor_seen",
            "sensor_shown",
            "sensor_emptied",
            "sensor_doubt",
            "sensor_dead",
            "vent_fitted",
            "vent_agreed",
            "vent_wrong",
            "shut_off_fitted",
            "shut_off_agreed",
            "shut_off_wrong",
            "supply_shut",
            "supply_from",
            "supply_slow",
            "supply_fast",
            "supply_before",
            "supply_late",
            "supply_early",
            "supply_wrong",
            "supply_unproven",
            "supply_excused",
            "lock_agreed",
            "lock_wrong",
            "index_wrong",
            "air_held",
            "air_swung",
            "air_trim",
            "air_good",
            "air_since",
            "air_ready",
            "move_gain",
            "arm_first",
            "low_head",
            "rest_angle",
            "let_off",
            "emptied",
            "empty_since",
            "drained_at",
            "air_trapped",
            "exhaust_bound",
            "exhaust_rate",
            "exhaust_late",
            "exhaust_slow",
            "exhaust_closed",
            "vent_timer",
        }
    ),
    "pid": frozenset({"gains", "supply_factor"}),
}
"""Fields that the controller's memory did not have in records of before; there they are as at power-up."""
_MOVED = {"exhaust_closed": np.dtype("?"), "vent_timer": np.dtype("f8")}
"""Fields that stood in both observers' memory, behind `started`, and are in the control's."""
_OBSERVERS = ("model", "air")


def _before_added() -> np.dtype[Any]:
    """Return SNAPSHOT without the fields of _ADDED, and with _MOVED where they were."""

    def remaining(name: str) -> np.dtype[Any]:
        dtype = SNAPSHOT[name]
        kept = [(field, dtype[field]) for field in dtype.names or () if field not in _ADDED.get(name, ())]
        if name in _OBSERVERS:
            kept[1:1] = _MOVED.items()
        return np.dtype(kept, align=True)

    return np.dtype([("tick", "i8"), ("time", "f8"), *((n, remaining(n)) for n in _KEPT)], align=True)


_LAYOUTS = {layout_of(dtype): dtype for dtype in (SNAPSHOT, _before_added())}
"""Layouts that can be read."""


def pack_snapshot(state: ControlState, snapshot: np.ndarray[Any, Any]) -> None:
    """Copy `state` into `snapshot` (one-element array of SNAPSHOT)."""
    snapshot["tick"], snapshot["time"] = state.control["tick"], state.control["time"]
    for name in _KEPT:
        snapshot[name] = getattr(state, name)


def unpack_snapshot(snapshot: np.ndarray[Any, Any]) -> ControlState:
    """Return a ControlState of its own with the values of `snapshot`."""
    state = new_control_state()
    for name in _KEPT:
        getattr(state, name)[:] = snapshot[name]
    return state


def read_snapshot(metadata: Mapping[str, Any], place: str) -> np.ndarray[Any, Any]:
    """Return the snapshot (one-element array of SNAPSHOT) in a record's `metadata`.

    Raises:
        BenchError: it is missing or damaged, or this program's controller has another memory; `place` is
            the record's path.
    """
    entry = metadata.get("snapshot")
    place = f"{place}: snapshot"
    if not isinstance(entry, Mapping):
        raise BenchError(
            place,
            "missing",
            "the controller's memory before the first tick",
            "Replay a record of this version.",
        )
    dtype = _LAYOUTS.get(str(entry.get("layout")))
    if dtype is None:
        raise BenchError(
            place,
            f"a controller's memory of layout {entry.get('layout')}",
            f"layout {layout_of(SNAPSHOT)}",
            "Replay it with the version of golfbench that wrote it, or renew the record.",
        )
    # A damaged text may promise any length: no more is unpacked than belongs there.
    inflate = zlib.decompressobj()
    try:
        data = inflate.decompress(base64.b64decode(entry["data"], validate=True), dtype.itemsize + 1)
    except (KeyError, TypeError, ValueError, zlib.error) as error:
        data, found = b"", f"not readable: {error}"
    else:
        found = f"{len(data)} bytes"
    if len(data) != dtype.itemsize or not inflate.eof:
        raise BenchError(place, found, f"{dtype.itemsize} bytes", "Restore the record from a copy.")
    return _completed(np.frombuffer(bytearray(data), dtype))


def _completed(read: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return `read` as SNAPSHOT; a field that it does not have is as at power-up."""
    if read.dtype == SNAPSHOT:
        return read
    snapshot = new_record(SNAPSHOT)
    pack_snapshot(new_control_state(), snapshot)
    snapshot["tick"], snapshot["time"] = read["tick"], read["time"]
    for name in _KEPT:
        for field in read.dtype[name].names or ():
            snapshot["control" if field in _MOVED else name][field] = read[name][field]
    return snapshot
