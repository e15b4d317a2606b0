"""Queue of records to be stored: the oldest first, with retries while the disk fails."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow.parquet  # noqa: F401 - now, not at the first record of a running bench

from bench.base.errors import BenchError
from bench.records.telemetry.recorder import write_swing
from bench.records.telemetry.swing_cutter import Cycles


class QueuedRecord(NamedTuple):
    """One record and its path."""

    path: Path
    began: datetime
    cycles: Cycles
    """Cycles of the record: `time` from the record's begin."""
    metadata: Mapping[str, Any]


class RecordQueue:
    """Queue of at most `room` records; records that do not fit are lost and counted."""

    def __init__(self, room: int, pause: float) -> None:
        """`pause`: s before a retry after a failure."""
        self._room, self._pause = room, pause
        self._waiting: deque[QueuedRecord] = deque()
        self._next_try = 0.0
        self.dropped = 0
        """Number of records lost for want of room."""
        self.fault = ""
        """Reason why the last record was not stored; empty if it was."""

    def __len__(self) -> int:
        """Return the number of waiting records."""
        return len(self._waiting)

    @property
    def owed_after(self) -> int | None:
        """Tick before the first cycle of the waiting swings; None if no swing waits."""
        firsts = [int(r.cycles["tick"][0]) for r in self._waiting]
        return min(firsts) - 1 if firsts else None

    def put(self, record: QueuedRecord) -> None:
        """Queue `record`; drop it without room."""
        if len(self._waiting) >= self._room:
            self.dropped += 1
            return
        self._waiting.append(record)

    def due(self, now: float, *, at_once: bool = False) -> QueuedRecord | None:
        """Return the oldest record, unless a retry is not due at `now` (s)."""
        return self._waiting[0] if self._waiting and (at_once or now >= self._next_try) else None

    def store(self, now: float, *, at_once: bool = False) -> QueuedRecord | None:
        """Store the record that is due; return it once stored."""
        record = self.due(now, at_once=at_once)
        if record is None:
            return None
        try:
            record.path.parent.mkdir(parents=True, exist_ok=True)
            write_swing(record.path, record.cycles, record.metadata)
        except (BenchError, OSError, MemoryError) as error:
            self.fault = str(error) or repr(error)
            self._next_try = now + self._pause
            return None
        self.fault = ""
        return self._waiting.popleft()


def record_path(folder: Path, time_utc: datetime, number: int) -> Path:
    """Return the path of record `number` that begins at `time_utc`."""
    return folder / f"{time_utc.astimezone(UTC):%Y%m%dT%H%M%S%fZ}-{number}.parquet"


def folder_fault(folder: Path, least_free: int) -> str:
    """Return why a record may not fit into `folder`, which is created; empty if it fits.

    `least_free` is in bytes. A cheap look every few seconds; the disk's own word is `RecordQueue.fault`.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        state = os.statvfs(folder)
    except OSError as error:
        return f"{folder}: {error.strerror or error}"
    if not os.access(folder, os.W_OK | os.X_OK):
        return f"{folder}: cannot be written to. Give its user the right, or name another data_dir"
    free = state.f_bavail * state.f_frsize
    if free < least_free:
        return f"{folder}: {free >> 20} MiB left on its disk, expected {least_free >> 20}. Free some space"
    return ""


def remove_partial(folder: Path) -> None:
    """Remove the partial files of a killed recorder in `folder`; only one recorder may write there."""
    for path in folder.glob(".*.parquet.*.partial"):
        with suppress(OSError):
            path.unlink()
