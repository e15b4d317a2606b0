from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base.shared_memory import SharedMemoryError, SharedRecord

VALUE = np.dtype([("number", "i8"), ("words", "f8", (5,)), ("flag", "?")], align=True)


def value_of(number: int) -> np.ndarray[Any, Any]:
    """Return a VALUE whose every field holds its number."""
    value = np.zeros(1, VALUE)
    value["number"], value["words"], value["flag"] = number, number + np.arange(5) / 8, number % 2
    return value


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "supervision"


@pytest.fixture
def writer(path: Path) -> Iterator[SharedRecord]:
    record = SharedRecord.create(path, VALUE)
    yield record
    record.close()


@pytest.fixture
def reader(writer: SharedRecord, path: Path) -> Iterator[SharedRecord]:
    record = SharedRecord.open(path, VALUE)
    yield record
    record.close()


def test_shared_record_unwritten_read_returns_version_0(reader: SharedRecord) -> None:
    into = value_of(7)
    assert reader.read(into) == 0
    assert into == value_of(7)


def test_shared_record_read_returns_newest_value_and_version(
    writer: SharedRecord, reader: SharedRecord
) -> None:
    into = np.zeros(1, VALUE)
    for number in range(1, 12):
        writer.write(value_of(number))
        if number % 3:
            assert reader.read(into) == number
            assert into == value_of(number)
    into = np.zeros(1, VALUE)
    assert reader.read(into) == 11, "again, into another array"
    assert into == value_of(11)


def test_shared_record_accepts_recarray(writer: SharedRecord, reader: SharedRecord) -> None:
    into = np.zeros(1, VALUE).view(np.recarray)
    writer.write(value_of(5).view(np.recarray))
    assert reader.read(into) == 1
    assert into == value_of(5)


def test_shared_record_opener_writes_and_creator_reads(writer: SharedRecord, reader: SharedRecord) -> None:
    into = np.zeros(1, VALUE)
    reader.write(value_of(3))
    assert writer.read(into) == 1
    assert into == value_of(3)


def test_shared_record_next_writer_continues_version(writer: SharedRecord, path: Path) -> None:
    writer.write(value_of(1))
    writer.close()
    follower = SharedRecord.open(path, VALUE)
    follower.write(value_of(2))
    into = np.zeros(1, VALUE)
    assert follower.read(into) == 2
    follower.close()


def test_shared_record_wrong_size_is_refused(writer: SharedRecord, reader: SharedRecord) -> None:
    with pytest.raises(ValueError, match="8 bytes"):
        writer.write(np.zeros(1))
    assert reader.read(np.zeros(1, VALUE)) == 0


def test_shared_record_create_existing_name_is_refused(writer: SharedRecord, path: Path) -> None:
    with pytest.raises(SharedMemoryError, match="supervision: found a file of that name, expected none"):
        SharedRecord.create(path, VALUE)
    assert [file.name for file in path.parent.iterdir()] == ["supervision"]


def test_shared_record_open_other_dtype_is_refused(writer: SharedRecord, path: Path) -> None:
    other = np.dtype([("number", "i8"), ("words", "f8", (5,)), ("switch", "?")], align=True)
    assert other.itemsize == VALUE.itemsize
    with pytest.raises(SharedMemoryError, match="records of other code"):
        SharedRecord.open(path, other)


def test_shared_record_open_missing_file_names_path(path: Path) -> None:
    with pytest.raises(SharedMemoryError, match="supervision: found no such file"):
        SharedRecord.open(path, VALUE)


def test_shared_record_create_missing_folder_raises(path: Path) -> None:
    with pytest.raises(SharedMemoryError, match="found No such file or directory, expected a folder"):
        SharedRecord.create(path / "deeper", VALUE)


def test_shared_record_close_twice_keeps_file(writer: SharedRecord, path: Path) -> None:
    writer.close()
    writer.close()
    assert path.exists()
