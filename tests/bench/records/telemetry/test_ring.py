from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.ring import NoRing, RingReader, RingWriter, ring_capacity
from drivers.base.shared_memory import SharedRecord

CAPACITY = 16


def cycles_of(*ticks: int) -> np.ndarray[Any, Any]:
    """Return one CYCLE for each of `ticks`, all of whose bytes hold the tick."""
    cycles = np.zeros((len(ticks), CYCLE.itemsize), np.uint8)
    cycles[:] = np.array(ticks, np.uint8)[:, np.newaxis]
    return cycles.reshape(-1).view(CYCLE)


def same(one: np.ndarray[Any, Any] | None, *ticks: int) -> bool:
    return one is not None and one.dtype == CYCLE and one.tobytes() == cycles_of(*ticks).tobytes()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ring"


@pytest.fixture
def write(path: Path) -> Iterator[RingWriter]:
    writer = RingWriter(path, CAPACITY)
    yield writer
    writer.close()


@pytest.fixture
def reader(write: RingWriter, path: Path) -> Iterator[RingReader]:
    reader = RingReader(path)
    yield reader
    reader.close()


def test_ring_reader_empty_ring_returns_no_records(reader: RingReader) -> None:
    assert reader.read().shape == (0,)
    assert reader.read().dtype == CYCLE
    assert (reader.newest(), reader.head, reader.lost) == (None, 0, 0)


def test_ring_reader_returns_records_once_in_order(write: RingWriter, reader: RingReader) -> None:
    for tick in range(1, 100):
        write(cycles_of(tick))
        if tick % 7 == 0:
            assert same(reader.read(), *range(tick - 6, tick + 1))
            assert reader.read().shape == (0,)
    assert (reader.head, write.head, reader.lost) == (99, 99, 0)


def test_ring_reader_read_limit_bounds_count(write: RingWriter, reader: RingReader) -> None:
    for tick in range(1, 9):
        write(cycles_of(tick))
    assert same(reader.read(5), 1, 2, 3, 4, 5)
    assert same(reader.read(5), 6, 7, 8)


def test_ring_reader_overrun_loses_oldest_and_counts(write: RingWriter, reader: RingReader) -> None:
    for tick in range(1, CAPACITY + 4):
        write(cycles_of(tick))
    assert same(reader.read(), *range(4, CAPACITY + 4))
    assert reader.lost == 3
    write(cycles_of(200))
    assert same(reader.read(), 200)
    assert reader.lost == 3


def test_ring_reader_late_start_position_follows_options(write: RingWriter, path: Path) -> None:
    for tick in range(1, CAPACITY + 4):
        write(cycles_of(tick))
    late, from_oldest = RingReader(path), RingReader(path, from_oldest=True)
    past, far_past = RingReader(path, past=2), RingReader(path, past=2 * CAPACITY)
    assert same(late.read(), CAPACITY + 3)
    assert same(from_oldest.read(), *range(4, CAPACITY + 4))
    assert same(past.read(), *range(CAPACITY + 1, CAPACITY + 4))
    assert same(far_past.read(), *range(4, CAPACITY + 4))
    past.close()
    far_past.close()
    assert (late.lost, from_oldest.lost) == (0, 0)
    late.close()
    from_oldest.close()


def test_ring_reader_newest_keeps_read_position(write: RingWriter, reader: RingReader) -> None:
    for tick in (1, 2, 3):
        write(cycles_of(tick))
        assert same(reader.newest(), tick)
        assert same(reader.newest(), tick)
    assert same(reader.read(), 1, 2, 3)


def test_ring_reader_returns_copies(write: RingWriter, reader: RingReader) -> None:
    write(cycles_of(1))
    newest, read = reader.newest(), reader.read()
    assert newest is not None
    newest["tick"] = read["tick"] = 0
    for tick in range(2, 3 + CAPACITY):
        write(cycles_of(tick))
    assert newest["tick"] == read["tick"] == 0


def test_ring_writer_wrong_record_size_is_refused(write: RingWriter, reader: RingReader) -> None:
    with pytest.raises(ValueError, match="8 bytes"):
        write(np.zeros(1))
    assert reader.read().shape == (0,)


def test_ring_writer_capacity_not_power_of_two_is_refused(path: Path) -> None:
    for capacity in (0, 1, 3, 1000):
        with pytest.raises(ValueError, match="power of two"):
            RingWriter(path, capacity)
    assert not path.exists()


def test_ring_writer_existing_file_is_refused(write: RingWriter, path: Path) -> None:
    with pytest.raises(NoRing, match="found a file of that name"):
        RingWriter(path, CAPACITY)


def test_ring_reader_shared_record_is_refused(path: Path) -> None:
    record = SharedRecord.create(path, CYCLE)
    with pytest.raises(NoRing, match="found kind b'record', expected kind b'ring'"):
        RingReader(path)
    record.close()


def test_ring_reader_missing_file_error_names_ring(path: Path) -> None:
    with pytest.raises(NoRing, match="ring: found no such file"):
        RingReader(path)


def test_ring_write_and_read_do_not_leak_memory(write: RingWriter, reader: RingReader) -> None:
    cycle = cycles_of(1)

    def blocks_after(rounds: int) -> int:
        for _ in range(rounds):
            write(cycle)
            reader.newest()
            reader.read()
        return sys.getallocatedblocks()

    before = blocks_after(100)
    assert abs(blocks_after(2000) - before) < 100


@pytest.mark.parametrize("rate", [100.0, 999.0, 1000.0, 1024.0, 1025.0, 4000.0, 5000.0])
def test_ring_capacity_holds_sixteen_seconds_at_each_rate(rate: float) -> None:
    capacity = ring_capacity(rate)
    assert capacity & (capacity - 1) == 0
    assert max(CAPACITY, 16.0 * rate) <= capacity <= max(16384, 32.0 * rate)
