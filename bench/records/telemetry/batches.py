"""Cycles on the wire: one message holds one Arrow IPC stream of one record batch, complete in itself.

Key `golfbench/<id>/telemetry`. The schema is that of `bench.records.telemetry.cycle_record.arrow_schema` with
its version, without units and descriptions (13 kB a message); the batch's own metadata are `sequence`, `lost`
and `time`, as text. Any Arrow implementation reads it.
"""

from __future__ import annotations

from functools import cache
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from bench.base.errors import BenchError
from bench.records.telemetry.cycle_record import (
    MAX_BATCH_CYCLES,
    SCHEMA_VERSION,
    arrow_schema,
    from_arrow,
    to_arrow,
)

_MAX_MESSAGE_BYTES = 1 << 20
_VERSION_KEY = b"golfbench_schema"
_PLACE = "telemetry message"
_ACTION = "Let bench and viewer run the same version of golfbench."


class Batch(NamedTuple):
    """Content of a message."""

    cycles: np.ndarray[Any, Any]
    """Records of CYCLE, `time` on the loop's clock."""
    sequence: int
    """Number of the message since the publisher's start, from 1 on; a gap: lost on the network."""
    lost: int
    """Records that the ring lost for the publisher, since its start."""
    time: float
    """UTC of the newest cycle's tick, s since 1970."""


@cache
def wire_schema() -> pa.Schema:
    """Return the schema of messages: names, types and version."""
    full = arrow_schema()
    return pa.schema([pa.field(f.name, f.type, nullable=False) for f in full], metadata=full.metadata)


def encode_batch(cycles: np.ndarray[Any, Any], sequence: int, lost: int, time: float) -> bytes:
    """Return the message with `cycles` (1 to MAX_BATCH_CYCLES records of CYCLE); the rest as in Batch.

    Raises:
        ValueError: no cycles, or too many.
    """
    if not 1 <= len(cycles) <= MAX_BATCH_CYCLES:
        raise ValueError(f"{len(cycles)} cycles, expected 1 to {MAX_BATCH_CYCLES}")
    schema = wire_schema()
    batch = to_arrow(cycles, schema)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as stream:
        facts = {"sequence": str(sequence), "lost": str(lost), "time": repr(time)}
        stream.write_batch(batch, custom_metadata=facts)
    message: bytes = sink.getvalue().to_pybytes()
    return message


def decode_batch(message: bytes) -> Batch:
    """Return the content of `message`; the cycles are preserved bit for bit.

    Raises:
        BenchError: the message is of another kind or version, or damaged.
    """
    if len(message) > _MAX_MESSAGE_BYTES:
        raise _bad(f"{len(message)} bytes", f"at most {_MAX_MESSAGE_BYTES}")
    try:
        with pa.ipc.open_stream(pa.py_buffer(message)) as stream:
            _check_schema(stream.schema)
            batch, facts = stream.read_next_batch_with_custom_metadata()
            if not 1 <= batch.num_rows <= MAX_BATCH_CYCLES:
                raise _bad(f"{batch.num_rows} cycles", f"1 to {MAX_BATCH_CYCLES}")
            batch.validate(full=True)
            if any(column.null_count for column in batch.columns):
                raise _bad("a missing value", "a value in every field")
            try:
                stream.read_next_batch()
            except StopIteration:
                pass
            else:
                raise _bad("several batches", "one")
        # A copy: the caller's values must not hang on the message.
        cycles = from_arrow(batch)
        sequence, lost = _whole(facts, b"sequence", 1), _whole(facts, b"lost", 0)
        time = float(_fact(facts, b"time"))
    except (pa.ArrowException, OSError, StopIteration, ValueError, MemoryError) as error:
        raise _bad(f"{type(error).__name__}: {error}"[:200], "an Arrow IPC stream of cycles") from error
    if not isfinite(time):
        raise _bad(f"time {time}", "a finite time")
    return Batch(cycles, sequence, lost, time)


def _check_schema(schema: pa.Schema) -> None:
    expected = wire_schema()
    version = (schema.metadata or {}).get(_VERSION_KEY, b"none")
    if version != expected.metadata[_VERSION_KEY]:
        raise _bad(f"schema {version.decode('utf-8', 'replace')[:40]!r}", f"cycle/{SCHEMA_VERSION}")
    if not schema.equals(expected):
        names = [f.name for f in expected if f.name not in schema.names] or ["another order or other types"]
        raise _bad(f"other columns ({names[0]})", f"the columns of schema {SCHEMA_VERSION}")


def _fact(facts: Any, key: bytes) -> str:
    value: bytes | None = facts.get(key) if facts is not None else None
    if value is None:
        raise _bad(f"no {key.decode()}", "sequence, lost and time in the batch's metadata")
    return value.decode()


def _whole(facts: Any, key: bytes, least: int) -> int:
    value = int(_fact(facts, key))
    if not least <= value < 1 << 63:
        raise _bad(f"{key.decode()} {value}", f"a whole number from {least} on")
    return value


def _bad(found: str, expected: str) -> BenchError:
    return BenchError(_PLACE, found, expected, _ACTION)
