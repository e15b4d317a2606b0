"""Memory of the controller at one tick, from which a replay starts.

The loop puts a snapshot into shared memory in each tick that accepts a request to move (home, arm, swing),
after the step; a replay of the record sets it and continues with the next tick. In a record's metadata it
is stored as text, see `bench.records.telemetry.swing_metadata.snapshot_entry`.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from bench.base.errors import BenchError
from bench.control.estimate.air import AIR_STATE
from bench.control.estimate.encoder import ENCODER_STATE
from bench.control.estimate.estimator import ESTIMATOR_STATE
from bench.control.estimate.residual_monitor import MODEL_STATE
from bench.control.law.pid import PID_STATE
from bench.control.step_records import CONTROL_STATE, ControlState, new_control_state
from bench.records.telemetry.swing_metadata import layout_of

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


def pack_snapshot(state: ControlState, snapshot: np.ndarray[Any, Any]) -> None:
    """Copy `state` into `snapshot` (one-element array of SNAPSHOT)."""
    snapshot["tick"], snapshot["time"] = state.control["tick"], state.control["time"]
    for name in ControlState._fields:
        snapshot[name] = getattr(state, name)


def unpack_snapshot(snapshot: np.ndarray[Any, Any]) -> ControlState:
    """Return a new ControlState with the values of `snapshot`."""
    state = new_control_state()
    for name in ControlState._fields:
        getattr(state, name)[:] = snapshot[name]
    return state


def read_snapshot(metadata: Mapping[str, Any], location: str) -> np.ndarray[Any, Any]:
    """Return the snapshot (one-element array of SNAPSHOT) in a record's `metadata`.

    Raises:
        BenchError: it is missing or damaged, or from a controller with other state variables; `location` is
            the record's path.
    """
    entry = metadata.get("snapshot")
    location = f"{location}: snapshot"
    if not isinstance(entry, Mapping):
        raise BenchError(
            location,
            "missing",
            "the controller's memory before the first tick",
            "Replay a record of this version.",
        )
    if entry.get("layout") != layout_of(SNAPSHOT):
        raise BenchError(
            location,
            f"a controller's memory of layout {entry.get('layout')}",
            f"layout {layout_of(SNAPSHOT)}",
            "Replay it with the version of golfbench that wrote it, or renew the record.",
        )
    # A damaged text may promise any length: no more is unpacked than belongs there.
    inflate = zlib.decompressobj()
    try:
        data = inflate.decompress(base64.b64decode(entry["data"], validate=True), SNAPSHOT.itemsize + 1)
    except (KeyError, TypeError, ValueError, zlib.error) as error:
        data, found = b"", f"not readable: {error}"
    else:
        found = f"{len(data)} bytes"
    if len(data) != SNAPSHOT.itemsize or not inflate.eof:
        raise BenchError(location, found, f"{SNAPSHOT.itemsize} bytes", "Restore the record from a copy.")
    return np.frombuffer(bytearray(data), SNAPSHOT)
