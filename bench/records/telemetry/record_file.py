"""One Parquet file per swing: every cycle, and metadata to interpret it; the queue of files to write."""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.base.atomic_file import atomic_path
from bench.base.errors import BenchError
from bench.records.telemetry.cycle_record import (
    CYCLE,
    ENUMERATIONS,
    FIELDS,
    SCHEMA_VERSION,
    arrow_schema,
    from_arrow,
    name_columns,
    to_arrow,
)

if TYPE_CHECKING:
    import pyarrow as pa

Cycles = np.ndarray[Any, Any]

METADATA_KEY, UNITS_KEY = b"golfbench", b"units"
"""Keys of the JSON texts in the Parquet file's key-value metadata."""

# Neighbouring samples of a float share their upper bytes: splitting the bytes into streams lets the
# compression see that. Names repeat: a dictionary holds them in a few bytes.
_FLOATS = [column for field in FIELDS if field.dtype == "f8" for column in field.columns]
_CODES = [column for field in FIELDS if field.dtype != "f8" for column in field.columns]
_OPTIONS: dict[str, Any] = {
    "compression": "zstd",
    "use_dictionary": [f"{field.name}_name" for field in FIELDS if field.names],
    "column_encoding": dict.fromkeys(_FLOATS, "BYTE_STREAM_SPLIT"),
    "write_statistics": _CODES,  # those that somebody selects rows by
}


def write_swing(path: Path, cycles: Cycles, metadata: Mapping[str, Any]) -> None:
    """Write the swing's `cycles` (n records of CYCLE) and `metadata` to `path`, whole or not at all.

    `metadata` holds what JSON can: versions, effective configuration, seed, profile, shot. The schema's
    version and the names of phases, reactions and causes are added; units stand in each column's metadata,
    and all together as JSON in the file's own (`units`), which DuckDB and polars show. Each code has a second
    column with its name ("phase", "phase_name"); readers of cycles take the code.
    Raises BenchError (disk full, folder missing or read-only) and TypeError or ValueError when the
    metadata is not JSON (NaN included) or the cycles are not of CYCLE; then `path` is untouched.
    """
    import pyarrow as pa  # 29 MB, and needed for files only
    import pyarrow.parquet as pq

    if cycles.dtype != CYCLE:
        raise TypeError(f"cycles have dtype {cycles.dtype}, expected CYCLE")
    text = json.dumps(
        {"schema_version": SCHEMA_VERSION, "enumerations": ENUMERATIONS, **metadata}, allow_nan=False
    )
    names = name_columns(cycles)
    schema = _schema(tuple((name, column.type) for name, column in names.items()))
    schema = schema.with_metadata(arrow_schema().metadata | {METADATA_KEY: text.encode()} | schema.metadata)
    table = pa.Table.from_arrays([*to_arrow(cycles).columns, *names.values()], schema=schema)
    with atomic_path(path) as partial:  # by its name: a Python stream would take the interpreter's lock
        pq.write_table(table, str(partial), **_OPTIONS)


@cache
def _schema(names: tuple[tuple[str, pa.DataType], ...]) -> pa.Schema:
    """Return the schema of a file with columns of `names` of codes; its metadata are all columns' units."""
    import pyarrow as pa

    schema = arrow_schema()
    for name, kind in names:
        about = {"unit": "1", "description": f"name of the code in {name.removesuffix('_name')}"}
        schema = schema.append(pa.field(name, kind, metadata=about))
    units = json.dumps({field.name: field.metadata[b"unit"].decode() for field in schema})
    return schema.with_metadata({UNITS_KEY: units.encode()})


class SwingRecord(NamedTuple):
    """A swing's record, as it is stored or to be stored."""

    path: Path
    cycles: Cycles
    metadata: dict[str, Any]

    @property
    def time_utc(self) -> datetime:
        """UTC time of its first cycle."""
        return datetime.fromisoformat(self.metadata["time_utc"])

    @property
    def begin_utc(self) -> float:
        """UTC time of the columns' zero, s since 1970; 0 if the record has none."""
        start = self.metadata.get("time_utc")
        if not isinstance(start, str) or not len(self.cycles):
            return 0.0
        return datetime.fromisoformat(start).timestamp() - float(self.cycles["time"][0])


def read_swing(path: Path) -> tuple[Cycles, dict[str, Any]]:
    """Return the cycles (records of CYCLE, bit for bit as written) and the metadata stored in `path`.

    Raises BenchError when the file is missing, no Parquet file, not a swing of golfbench, or of a
    schema version that this program does not know.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    place, wanted = str(path), "a swing's record (.parquet)"
    other_version = "read it with the version of golfbench that wrote it"
    if path.is_dir():  # pyarrow would join its files
        raise BenchError(place, "a folder", wanted, "Name a file in this folder.")
    try:
        table = pq.read_table(path, memory_map=False)
    except FileNotFoundError as error:
        raise BenchError(place, "no such file", wanted, "Correct the path of the record.") from error
    except (OSError, pa.ArrowException) as error:
        raise BenchError(place, f"unreadable: {error}", wanted, "restore it from a copy") from error
    stored = (table.schema.metadata or {}).get(METADATA_KEY)
    if stored is None:
        found = "a Parquet file without golfbench metadata"
        raise BenchError(place, found, "a swing's record written by golfbench", "name a swing's file")
    metadata: dict[str, Any] = json.loads(stored)
    if (version := metadata.get("schema_version")) != SCHEMA_VERSION:
        raise BenchError(place, f"schema version {version}", f"version {SCHEMA_VERSION}", other_version)
    try:
        return from_arrow(table), metadata
    except KeyError as error:
        found, wanted = f"a record without {error.args[0]}", f"the columns of schema {SCHEMA_VERSION}"
        raise BenchError(place, found, wanted, other_version) from error


def record_files(places: Sequence[Path]) -> list[Path]:
    """Return the records at `places` in order; a folder stands for all records in it, sorted by name.

    Raises:
        BenchError: a place does not exist, or no record is found.
    """
    files: list[Path] = []
    for location in places:
        if location.is_dir():
            files += sorted(location.rglob("*.parquet"))
        elif location.exists():
            files.append(location)
        else:
            found, expected = "no such file or folder", "a record or a folder of records"
            raise BenchError(str(location), found, expected, "Correct the path of the records.")
    if not files:
        place = ", ".join(map(str, places)) or "records"
        action = "Give a folder such as data/campaigns/ID/swings."
        raise BenchError(place, "no record (.parquet)", "at least one record", action)
    return files


class RecordQueue:
    """Queue of at most `room` records; records that do not fit are lost and counted."""

    def __init__(self, room: int, pause: float) -> None:
        """`pause`: s before a retry after a failure."""
        self._room, self._pause = room, pause
        self._waiting: deque[SwingRecord] = deque()
        self._next_try = 0.0
        self.dropped = 0
        """Number of records lost for want of room."""
        self.fault = ""
        """Reason why the last record was not stored; empty if it was."""

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def owed_after(self) -> int | None:
        """Tick before the first cycle of the waiting swings; None if no swing waits."""
        firsts = [int(r.cycles["tick"][0]) for r in self._waiting]
        return min(firsts) - 1 if firsts else None

    def put(self, record: SwingRecord) -> None:
        """Queue `record`; drop it without room."""
        if len(self._waiting) >= self._room:
            self.dropped += 1
            return
        self._waiting.append(record)

    def due(self, now: float, *, at_once: bool = False) -> SwingRecord | None:
        """Return the oldest record, unless a retry is not due at `now` (s)."""
        return self._waiting[0] if self._waiting and (at_once or now >= self._next_try) else None

    def store(self, now: float, *, at_once: bool = False) -> SwingRecord | None:
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
