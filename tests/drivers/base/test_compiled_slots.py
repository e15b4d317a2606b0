"""Compiled writer and reader of mapped records against those in Python: the same bytes, the same rules."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from zlib import crc32

import numba
import numpy as np
import pytest

from drivers.base.compiled_slots import copy_words, fetch_record, newest_record, put_native, put_record
from drivers.base.shared_memory import MappedSlots

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="addresses are for compiled code only")

VALUE = np.dtype([("number", "i8"), ("rest", "u1", (40,))])
SLOTS = 4


def value(number: int) -> np.ndarray:
    record = np.zeros(1, VALUE)
    record["number"], record["rest"] = number, np.arange(40) * number % 251
    return record


def create(path: Path) -> MappedSlots:
    return MappedSlots.create(path, "record", VALUE, SLOTS)


@pytest.fixture
def slots(tmp_path: Path) -> Iterator[MappedSlots]:
    made = create(tmp_path / "slots")
    yield made
    made.close()


def put(slots: MappedSlots, number: int) -> bool:
    record = value(number)
    return bool(put_record(slots.block, record.ctypes.data))


def fetch(slots: MappedSlots, into: np.ndarray) -> bool:
    scratch = np.zeros(1, VALUE)
    return bool(fetch_record(slots.block, into.ctypes.data, scratch.ctypes.data))


@pytest.mark.parametrize("start", [0, 1, 77, 2**32 + 5])
def test_copy_words_checksum_equals_zlib_crc32(start: int) -> None:
    data = np.random.default_rng(start).integers(0, 256, 696, np.uint8)
    copy = np.zeros_like(data)
    found = copy_words(data.ctypes.data, copy.ctypes.data, len(data), start)
    assert found == crc32(data.tobytes(), start & 0xFFFFFFFF)
    assert copy.tobytes() == data.tobytes()


def test_put_record_writes_same_bytes_as_python(tmp_path: Path) -> None:
    one, other = create(tmp_path / "compiled"), create(tmp_path / "python")
    one.put(value(1).tobytes())
    other.put(value(1).tobytes())
    for number in range(2, 12):
        if number == 7:  # in turn
            one.put(value(number).tobytes())
        else:
            assert put(one, number)
        other.put(value(number).tobytes())
        assert (tmp_path / "compiled").read_bytes() == (tmp_path / "python").read_bytes()
    for slots in (one, other):
        slots.close()


def test_put_record_first_or_closed_declines(slots: MappedSlots) -> None:
    assert not put(slots, 1)  # a writer before this one may have died
    assert slots.head == 0
    slots.put(value(1).tobytes())
    assert put(slots, 2)
    slots.close()
    assert not put(slots, 3)
    assert not fetch(slots, value(0))
    assert newest_record(slots.block) == -1
    assert put_native.address


def test_fetch_record_reads_newest_record_once(slots: MappedSlots, tmp_path: Path) -> None:
    reader = MappedSlots.open(tmp_path / "slots", "record", VALUE, writable=False)
    into = value(99)
    assert fetch(reader, into)
    assert into["number"] == 99  # nothing written yet
    for number in range(1, 10):
        slots.put(value(number).tobytes())
        assert newest_record(reader.block) == number
        assert fetch(reader, into)
        assert into.tobytes() == value(number).tobytes()
    into["number"] = -1
    assert fetch(reader, into)
    assert into["number"] == -1  # nothing new
    reader.close()


@pytest.mark.parametrize("spoiled", ["number", "check", "record"])
def test_fetch_record_torn_record_keeps_previous(slots: MappedSlots, tmp_path: Path, spoiled: str) -> None:
    reader = MappedSlots.open(tmp_path / "slots", "record", VALUE, writable=False)
    into = np.zeros(1, VALUE)
    slots.put(value(1).tobytes())
    assert fetch(reader, into)
    slots.put(value(2).tobytes())
    start = 128 + 2 * int(slots.block[2]) + {"number": 0, "check": 8, "record": 16}[spoiled]
    with (tmp_path / "slots").open("r+b") as file:
        file.seek(start)
        file.write(b"\xff")
    assert fetch(reader, into)
    assert into.tobytes() == value(1).tobytes()
    reader.close()
