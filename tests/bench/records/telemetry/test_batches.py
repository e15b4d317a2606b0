from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.errors import BenchError
from bench.records.telemetry.batches import decode_batch, encode_batch, wire_schema
from bench.records.telemetry.cycle_record import CYCLE, FIELDS, MAX_BATCH_CYCLES, arrow_schema


def some_cycles(count: int, seed: int = 0) -> np.ndarray[Any, Any]:
    """Return cycles of random bytes, NaN payloads included; only a bool must be 0 or 1."""
    random = np.random.default_rng(seed)
    cycles = np.zeros(count, CYCLE)
    for field in FIELDS:
        shape = (count, *field.shape)
        if field.dtype == "?":
            cycles[field.name] = random.integers(0, 2, shape).astype(bool)
        else:
            width = np.dtype(field.dtype).itemsize
            data = random.integers(0, 256, (count, width * max(1, len(field.components))), np.uint8)
            cycles[field.name] = data.view(field.dtype).reshape(shape)
    return cycles


def message_of(batches: list[pa.RecordBatch], facts: dict[str, str] | None, schema: pa.Schema) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as stream:
        for batch in batches:
            stream.write_batch(batch, custom_metadata=facts)
    message: bytes = sink.getvalue().to_pybytes()
    return message


def parts(count: int = 2) -> pa.RecordBatch:
    with pa.ipc.open_stream(encode_batch(some_cycles(count), 1, 0, 1.0)) as stream:
        return stream.read_next_batch()


@given(st.integers(1, MAX_BATCH_CYCLES), st.integers(0, 1000), st.integers(1, 2**62), st.floats(0, 1e10))
def test_decode_batch_restores_cycles_bit_for_bit(count: int, seed: int, sequence: int, time: float) -> None:
    cycles = some_cycles(count, seed)
    batch = decode_batch(encode_batch(cycles, sequence, seed, time))
    assert batch.cycles.tobytes() == cycles.tobytes()
    assert batch.cycles.dtype == CYCLE
    assert (batch.sequence, batch.lost, batch.time) == (sequence, seed, time)


def test_encode_batch_longest_batch_fits_size_limit() -> None:
    assert len(encode_batch(some_cycles(MAX_BATCH_CYCLES), 2**62, 2**62, 1e9 / 3)) < 65_000


def test_encode_batch_stream_carries_names_and_version() -> None:
    with pa.ipc.open_stream(encode_batch(some_cycles(3), 5, 2, 7.5)) as stream:
        batch, facts = stream.read_next_batch_with_custom_metadata()
    assert batch.schema.names == arrow_schema().names
    assert batch.schema.types == arrow_schema().types
    assert batch.schema.metadata == arrow_schema().metadata
    assert dict(facts) == {b"sequence": b"5", b"lost": b"2", b"time": b"7.5"}


@pytest.mark.parametrize("count", [0, MAX_BATCH_CYCLES + 1])
def test_encode_batch_invalid_cycle_count_raises_error(count: int) -> None:
    with pytest.raises(ValueError, match="cycles"):
        encode_batch(np.zeros(count, CYCLE), 1, 0, 0.0)


def bad_messages() -> dict[str, tuple[bytes, str]]:
    good = {"sequence": "1", "lost": "0", "time": "1.0"}
    schema, two = wire_schema(), parts()
    old = schema.with_metadata({b"golfbench_schema": b"cycle/1"})
    fewer = two.drop_columns(["velocity_arm"])
    narrow = schema.set(0, pa.field("tick", pa.int32(), nullable=False))
    nullable = pa.schema([pa.field(f.name, f.type) for f in schema], metadata=schema.metadata)

    def two_with(first: pa.Array, schema: pa.Schema) -> pa.RecordBatch:
        return pa.RecordBatch.from_arrays([first, *two.columns[1:]], schema=schema)

    gap = two_with(pa.array([None, 1], schema.types[0]), nullable)
    whole = message_of([two], good, schema)

    def facts(**changes: str) -> bytes:
        return message_of([two], {**good, **changes}, schema)

    return {
        "nothing": (b"", "Arrow IPC"),
        "noise": (bytes(range(256)) * 8, "Arrow IPC"),
        "too long": (b"\0" * (2**20 + 1), "at most"),
        "cut off": (whole[:-2000], "Arrow IPC"),
        "no batch": (message_of([], None, schema), "Arrow IPC"),
        "two batches": (message_of([two, two], good, schema), "several"),
        "empty batch": (message_of([two.slice(0, 0)], good, schema), "0 cycles"),
        "too many cycles": (message_of([_many()], good, schema), "65 cycles"),
        "another version": (message_of([two.replace_schema_metadata(old.metadata)], good, old), "cycle/1"),
        "no version": (message_of([two.replace_schema_metadata({})], good, schema.with_metadata({})), "none"),
        "a column less": (message_of([fewer], good, fewer.schema), "velocity_arm"),
        "another type": (
            message_of([two_with(pa.array([1, 2], pa.int32()), narrow)], good, narrow),
            "other types",
        ),
        "a missing value": (message_of([gap], good, nullable), "other columns|missing"),
        "no metadata": (message_of([two], None, schema), "no sequence"),
        "sequence 0": (facts(sequence="0"), "sequence 0"),
        "sequence no number": (facts(sequence="x"), "Arrow IPC"),
        "lost below 0": (facts(lost="-1"), "lost -1"),
        "lost too great": (facts(lost=str(2**63)), "lost"),
        "time no number": (facts(time="now"), "Arrow IPC"),
        "time not finite": (facts(time="nan"), "time nan"),
    }


def _many() -> pa.RecordBatch:
    return pa.concat_batches([parts(60), parts(5)])


@pytest.mark.parametrize("name", bad_messages())
def test_decode_batch_invalid_message_is_refused(name: str) -> None:
    message, text = bad_messages()[name]
    with pytest.raises(BenchError, match=text) as error:
        decode_batch(message)
    assert error.value.location == "telemetry message"


@given(st.data())
def test_decode_batch_damaged_message_gives_cycles_or_bench_error(data: st.DataObject) -> None:
    message = bytearray(encode_batch(some_cycles(4), 3, 0, 1.0))
    for _ in range(data.draw(st.integers(1, 4))):
        message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    try:
        batch = decode_batch(bytes(message[: data.draw(st.integers(len(message) // 2, len(message)))]))
    except BenchError:
        return
    assert batch.cycles.dtype == CYCLE
    assert 1 <= len(batch.cycles) <= MAX_BATCH_CYCLES
