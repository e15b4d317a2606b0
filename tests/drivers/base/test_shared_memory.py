from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.base.shared_memory import MappedSlots, SharedMemoryError

VALUE = np.dtype([("number", "i8"), ("rest", "u1", (13,))])
KIND = "record"
SLOTS = 4
SAME_FOLDER = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def data_of(number: int) -> bytes:
    return bytes([number]) * VALUE.itemsize


def opened(path: Path, dtype: np.dtype[Any] = VALUE, kind: str = KIND) -> MappedSlots:
    return MappedSlots.open(path, kind, dtype, writable=False)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "slots"


@pytest.fixture
def slots(path: Path) -> Iterator[MappedSlots]:
    made = MappedSlots.create(path, KIND, VALUE, SLOTS)
    yield made
    made.close()


@pytest.fixture
def reader(slots: MappedSlots, path: Path) -> Iterator[MappedSlots]:
    reader = opened(path)
    yield reader
    reader.close()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the bytes of a good file."""
    path = tmp_path_factory.mktemp("whole") / "slots"
    made = MappedSlots.create(path, KIND, VALUE, SLOTS)
    made.put(data_of(1))
    made.close()
    return path.read_bytes()


def test_mapped_slots_fetch_returns_last_records_by_number(slots: MappedSlots, reader: MappedSlots) -> None:
    for number in range(1, 11):
        slots.put(data_of(number))
        assert reader.head == number
        there = range(max(1, number - SLOTS + 1), number + 1)
        for other in range(13):
            assert reader.fetch(other) == (data_of(other) if other in there else None)


def test_mapped_slots_read_only_put_raises(reader: MappedSlots) -> None:
    with pytest.raises(TypeError, match="read-only"):
        reader.put(data_of(1))


def test_mapped_slots_file_is_private_and_allocated(slots: MappedSlots, path: Path) -> None:
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.stat().st_blocks * 512 >= path.stat().st_size, "memory is reserved: no SIGBUS later"


def test_mapped_slots_fill_whole_cache_lines(path: Path) -> None:
    for size in (1, 8, 32, 33, 100):
        file = path.with_name(str(size))
        MappedSlots.create(file, KIND, np.dtype([("a", "u1", (size,))]), 2).close()
        assert (file.stat().st_size - 128) % (2 * 64) == 0


# A writer that ends in the middle of a write -----------------------------------------------------------


class _Death(Exception):
    pass


class _Dying:
    """Memory that takes some more stores, then ends its writer."""

    def __init__(self, memory: Any, left: list[int]) -> None:
        self.memory, self.left = memory, left

    def __getitem__(self, location: Any) -> Any:
        return self.memory[location]

    def __setitem__(self, location: Any, value: Any) -> None:
        self.left[0] -= 1
        if self.left[0] < 0:
            raise _Death
        self.memory[location] = value


STORES = 5


@pytest.mark.parametrize("stores", range(STORES + 1))
@pytest.mark.parametrize("before", range(SLOTS + 3))
def test_mapped_slots_writer_death_spoils_only_oldest(stores: int, before: int, path: Path) -> None:
    slots = MappedSlots.create(path, KIND, VALUE, SLOTS)
    for number in range(1, before + 1):
        slots.put(data_of(number))
    dying, left = MappedSlots.open(path, KIND, VALUE, writable=True), [stores]
    words, memory = dying._words, dying._memory
    dying._words, dying._memory = _Dying(words, left), _Dying(memory, left)  # type: ignore[assignment]
    try:
        dying.put(data_of(200))
        died = False
    except _Death:
        died = True
    assert died == (stores < STORES)

    assert slots.head == before + (not died)
    for number in range(max(1, before - SLOTS + 2), before + 1):
        assert slots.fetch(number) == data_of(number)
    if (oldest := before - SLOTS + 1) > 0:
        assert slots.fetch(oldest) == (None if stores else data_of(oldest))

    follower = MappedSlots.open(path, KIND, VALUE, writable=True)
    follower.put(data_of(100))
    number = follower.head
    assert number == before + (2 if stores >= STORES - 1 else 1), "a number is given once"
    assert slots.fetch(number) == data_of(100)
    for left_over in (slots, follower):
        left_over.close()
    words.release()
    memory.close()


@given(location=st.integers(0, VALUE.itemsize + 4 * 8), bit=st.integers(0, 7))
@SAME_FOLDER
def test_mapped_slots_flipped_bit_is_detected(location: int, bit: int, slots: MappedSlots) -> None:
    slots.put(data_of(7))
    number = slots.head
    at = 128 + number % SLOTS * 64 + location
    memory = slots._memory
    memory[at] ^= 1 << bit
    assert slots.fetch(number) in {None, data_of(7)}  # the same when only padding changed
    if location < 16 + VALUE.itemsize:
        assert slots.fetch(number) is None
    memory[at] ^= 1 << bit
    assert slots.fetch(number) == data_of(7)


def test_mapped_slots_mixed_record_is_detected(slots: MappedSlots) -> None:
    slots.put(data_of(1))
    start = 128 + 64 + 16
    slots._memory[start : start + 8] = data_of(2)[:8]  # as if these bytes were seen before their number
    assert slots.fetch(1) is None


def test_mapped_slots_old_record_with_new_number_is_detected(slots: MappedSlots) -> None:
    slots.put(data_of(1))
    slots._words[(128 + 64) >> 3] = slots._words[((128 + 64) >> 3) + slots._end] = 1 + SLOTS
    assert slots.fetch(1 + SLOTS) is None


# Files that are not ours -------------------------------------------------------------------------------


def refused(path: Path) -> str:
    """Return the refusal of the file at `path`; every refusal contains the path and an action."""
    with pytest.raises(SharedMemoryError) as caught:
        opened(path)
    location, *_, action = caught.value.args
    assert location == str(path)
    assert action.endswith(".")
    return str(caught.value)


@given(content=st.binary(max_size=1000))
@SAME_FOLDER
def test_mapped_slots_garbage_file_is_refused(content: bytes, path: Path) -> None:
    path.write_bytes(content)
    refused(path)


@given(data=st.data())
@SAME_FOLDER
def test_mapped_slots_truncated_file_is_refused(data: st.DataObject, whole: bytes, path: Path) -> None:
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    assert "bytes" in refused(path)


@pytest.mark.parametrize("longer", [1, 64, mmap.PAGESIZE])
def test_mapped_slots_oversized_file_is_refused(longer: int, whole: bytes, path: Path) -> None:
    path.write_bytes(whole + bytes(longer))
    assert f"found {len(whole) + longer} bytes with 4 slots, expected {len(whole)} bytes" in refused(path)


def test_mapped_slots_zero_file_is_refused(whole: bytes, path: Path) -> None:
    path.write_bytes(bytes(len(whole)))
    assert "begin with" in refused(path)


@given(location=st.integers(0, 55), value=st.integers(0, 255))
@SAME_FOLDER
def test_mapped_slots_wrong_header_byte_is_refused(
    location: int, value: int, whole: bytes, path: Path
) -> None:
    content = bytearray(whole)
    if content[location] == value:
        return
    content[location] = value
    path.write_bytes(content)
    refused(path)


@given(slots=st.integers(0, 2**64 - 1))
@SAME_FOLDER
def test_mapped_slots_wrong_slot_count_is_refused(slots: int, whole: bytes, path: Path) -> None:
    if slots != SLOTS:
        path.write_bytes(whole[:24] + slots.to_bytes(8, "little") + whole[32:])
        assert f"{slots} slots" in refused(path)


@given(content=st.binary(min_size=8, max_size=512))
@SAME_FOLDER
def test_mapped_slots_arbitrary_content_reads_safely(content: bytes, whole: bytes, path: Path) -> None:
    path.write_bytes((whole[:64] + content)[: len(whole)].ljust(len(whole), b"\xff"))
    reader = opened(path)
    for number in (0, 1, reader.head, max(0, reader.head - 1), 2**64 - 1):
        data = reader.fetch(number)
        assert data is None or len(data) == VALUE.itemsize
    reader.close()


def test_mapped_slots_refusal_names_difference(whole: bytes, path: Path) -> None:
    path.write_bytes(whole[:8] + b"\2" + whole[9:])
    assert "layout version 2, expected version 1" in refused(path)
    path.write_bytes(whole)
    with pytest.raises(SharedMemoryError, match="kind b'record', expected kind b'ring'"):
        opened(path, kind="ring")
    for other in (
        np.dtype([("number", "i8"), ("rest", "u1", (14,))]),
        np.dtype([("number", "f8"), ("rest", "u1", (13,))]),
        np.dtype([("number", "i8"), ("others", "u1", (13,))]),
        np.dtype([("rest", "u1", (13,)), ("number", "i8")]),
    ):
        with pytest.raises(SharedMemoryError, match=r"records of other code: 21 bytes, type [0-9a-f]{32}"):
            opened(path, other)


def test_mapped_slots_irregular_file_is_refused(path: Path, tmp_path: Path, whole: bytes) -> None:
    (tmp_path / "target").write_bytes(whole)
    path.symlink_to(tmp_path / "target")
    assert "symbolic links" in refused(path)
    path.unlink()
    os.mkfifo(path)
    assert "no regular file" in refused(path)
    path.unlink()
    path.mkdir()
    assert "no regular file" in refused(path)


def test_mapped_slots_create_without_space_raises(path: Path) -> None:
    huge = np.dtype([("bytes", "u1", (2**30,))])
    with pytest.raises(SharedMemoryError, match="bytes left"):
        MappedSlots.create(path, KIND, huge, 2**30)
    assert list(path.parent.iterdir()) == []


def test_mapped_slots_refused_file_closes_descriptor(path: Path) -> None:
    path.write_bytes(b"garbage")
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(10):
        refused(path)
    assert len(os.listdir("/proc/self/fd")) == before
