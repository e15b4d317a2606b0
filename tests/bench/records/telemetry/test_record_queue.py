from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np

from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.record_file import (
    RecordQueue,
    SwingRecord,
    folder_fault,
    read_swing,
    record_path,
    remove_partial,
)


def record(path: Path, number: int = 1, kind: str = "swing") -> SwingRecord:
    cycles = np.zeros(5, CYCLE)
    cycles["tick"] = number
    return SwingRecord(path / f"{number}.parquet", cycles, {"kind": kind, "number": number})


@contextmanager
def as_nobody() -> Iterator[None]:
    """Run as a user without write permission."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


def test_record_queue_stores_in_order_and_creates_folders(tmp_path: Path) -> None:
    queue = RecordQueue(3, 1.0)
    for number in (1, 2):
        queue.put(record(tmp_path / "swings" / "b", number))
    stored = [queue.store(0.0), queue.store(0.0), queue.store(0.0)]
    assert [s and s.metadata["number"] for s in stored] == [1, 2, None]
    cycles, metadata = read_swing(tmp_path / "swings" / "b" / "2.parquet")
    assert metadata["number"] == 2
    assert cycles["tick"][0] == 2


def test_record_queue_unwritable_folder_keeps_record_and_retries(tmp_path: Path) -> None:
    (sealed := tmp_path / "sealed").mkdir(mode=0o555)
    queue = RecordQueue(3, 1.0)
    queue.put(record(sealed))
    with as_nobody():
        assert queue.store(10.0) is None
        assert "Permission denied" in queue.fault or "cannot" in queue.fault
        assert folder_fault(sealed, 0)
        assert folder_fault(sealed / "below", 0)
    sealed.chmod(0o755)
    assert queue.store(10.9) is None, "it keeps a pause between two tries"
    assert queue.fault
    assert queue.store(11.0) is not None
    assert not queue.fault
    assert os.listdir(sealed) == ["1.parquet"]


def test_record_queue_full_drops_newest_record(tmp_path: Path) -> None:
    queue = RecordQueue(3, 1.0)
    for number in range(1, 7):
        queue.put(record(tmp_path, number))
    assert len(queue) == 3
    assert queue.dropped == 3
    kept = []
    while stored := queue.store(0.0):
        kept.append(stored.metadata["number"])
    assert kept == [1, 2, 3]


def test_folder_fault_reports_low_space_and_blocked_path(tmp_path: Path) -> None:
    assert not folder_fault(tmp_path / "new" / "folder", 1)
    assert (tmp_path / "new" / "folder").is_dir()
    assert "MiB left" in folder_fault(tmp_path, 1 << 62)
    (tmp_path / "file").touch()
    assert str(tmp_path / "file") in folder_fault(tmp_path / "file" / "x", 1)


def test_record_path_name_is_utc_time_and_number(tmp_path: Path) -> None:
    time = datetime(2026, 3, 1, 1, 2, 3, 45, timezone(timedelta(hours=2)))
    assert record_path(tmp_path, time, 12).name == "20260228T230203000045Z-12.parquet"
    assert record_path(tmp_path, time.astimezone(UTC), 12) == record_path(tmp_path, time, 12)


def test_remove_partial_deletes_partial_files_only(tmp_path: Path) -> None:
    for name in (".x.parquet.0123abcd.partial", "x.parquet", ".hidden"):
        (tmp_path / name).touch()
    remove_partial(tmp_path)
    remove_partial(tmp_path / "absent")
    assert sorted(os.listdir(tmp_path)) == [".hidden", "x.parquet"]
