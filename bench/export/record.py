"""A record to export: cycles and metadata as stored, the columns, and the changes in it."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.lifecycle import CAUSE_TEXT, Cause, Phase, Reaction, State
from bench.telemetry.cycle_record import arrow_schema
from bench.telemetry.recorder import read_swing


class ExportColumn(NamedTuple):
    """A column: name, unit and description."""

    name: str
    unit: str
    """SI; "1" for pure numbers, codes and switches."""
    description: str


class ExportRecord(NamedTuple):
    """Contents of a record's file."""

    path: Path
    cycles: np.ndarray[Any, Any]
    """Records of CYCLE."""
    metadata: dict[str, Any]

    @property
    def begin_utc(self) -> float:
        """UTC time of the columns' zero, s since 1970; 0 if the record has none."""
        start = self.metadata.get("time_utc")
        if not isinstance(start, str) or not len(self.cycles):
            return 0.0
        return datetime.fromisoformat(start).timestamp() - float(self.cycles["time"][0])


def read_record(path: Path) -> ExportRecord:
    """Return the record at `path`.

    Raises:
        BenchError: it is missing, damaged or no record.
    """
    return ExportRecord(path, *read_swing(path))


def columns() -> list[ExportColumn]:
    """Return the columns of a record in order."""
    return [
        ExportColumn(field.name, field.metadata[b"unit"].decode(), field.metadata[b"description"].decode())
        for field in arrow_schema()
    ]


class Change(NamedTuple):
    """A cycle that differs from the one before."""

    row: int
    cause: Cause
    """Cause of a stop; NONE without one."""
    text: str


def changes(cycles: np.ndarray[Any, Any]) -> Iterator[Change]:
    """Yield each change in `cycles`, the first cycle included."""
    keys = np.stack([cycles[name].astype(int) for name in ("state", "phase", "reaction", "trip")], axis=1)
    before = np.vstack([np.full((1, 4), -1), keys[:-1]])
    for row in np.flatnonzero(np.any(keys != before, axis=1)):
        state, phase, reaction, cause = keys[row].tolist()
        text = f"{State(state).name}, phase {Phase(phase).name}, reaction {Reaction(reaction).name}"
        yield Change(int(row), Cause(cause), f"{text}: {CAUSE_TEXT[Cause(cause)]}" if cause else text)
