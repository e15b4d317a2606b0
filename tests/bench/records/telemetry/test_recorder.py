from __future__ import annotations

import json
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bench.base.errors import BenchError
from bench.records.telemetry.atomic_file import atomic_file
from bench.records.telemetry.cycle_record import CYCLE, SCHEMA_VERSION
from bench.records.telemetry.recorder import METADATA_KEY, read_swing, write_swing

Cycles = np.ndarray[Any, Any]
METADATA = {"seed": 7, "profile": "thesis", "configuration": {"rate_hz": 1000}, "shot": 3}


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond `size` bytes: as good as a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_swing_comes_back_bit_for_bit(tmp_path: Path, make_swing: Callable[[int], Cycles]) -> None:
    cycles = make_swing(2)
    cycles["plant_angle"][3:9] = np.nan
    write_swing(tmp_path / "swing.parquet", cycles, METADATA)
    again, metadata = read_swing(tmp_path / "swing.parquet")
    assert again.dtype == CYCLE
    assert again.tobytes() == cycles.tobytes()
    assert METADATA.items() <= metadata.items()
    assert metadata["schema_version"] == SCHEMA_VERSION
    assert metadata["enumerations"]["phase"]["5"] == "DOWNSWING"
    assert metadata["enumerations"]["reaction"]["3"] == "BLIND_BRAKE"
    assert os.listdir(tmp_path) == ["swing.parquet"]


def test_the_same_swing_gives_the_same_bytes(tmp_path: Path, make_swing: Callable[[int], Cycles]) -> None:
    for name in ("a", "b"):
        write_swing(tmp_path / name, make_swing(2), METADATA)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_other_programs_find_plain_columns_with_units(
    tmp_path: Path, make_swing: Callable[[int], Cycles]
) -> None:
    write_swing(tmp_path / "swing.parquet", make_swing(0), METADATA)
    table = pq.read_table(tmp_path / "swing.parquet", columns=["time", "angle_wrist", "ball_present"])
    assert table.schema.field("angle_wrist").metadata[b"unit"] == b"rad"
    assert table.schema.field("ball_present").type == pa.bool_()
    assert table.num_rows == 2100


def test_a_full_disk_is_told_and_leaves_the_old_file(
    tmp_path: Path, make_swing: Callable[[int], Cycles]
) -> None:
    path = tmp_path / "swing.parquet"
    path.write_bytes(b"before")
    with largest_file(20_000), pytest.raises(BenchError, match="nothing was stored"):
        write_swing(path, make_swing(0), METADATA)
    assert os.listdir(tmp_path) == ["swing.parquet"]
    assert path.read_bytes() == b"before"


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    for folder in (tmp_path / "absent", Path("/proc")):
        with pytest.raises(BenchError, match="folder that can be written"):
            write_swing(folder / "swing.parquet", np.zeros(1, CYCLE), {})


def test_a_read_only_folder_is_told(tmp_path: Path) -> None:
    (folder := tmp_path / "sealed").mkdir(mode=0o555)
    root = os.geteuid() == 0
    if root:  # root may write anywhere: become nobody for a moment
        os.seteuid(65534)
    try:
        with pytest.raises(BenchError, match="Permission denied"):
            write_swing(folder / "swing.parquet", np.zeros(1, CYCLE), {})
    finally:
        if root:
            os.seteuid(0)
    assert os.listdir(folder) == []


def test_an_interruption_leaves_nothing_behind(tmp_path: Path) -> None:
    def interrupted() -> None:
        with atomic_file(tmp_path / "report.html") as stream:
            stream.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert os.listdir(tmp_path) == []


def test_metadata_must_be_json_and_cycles_must_be_cycles(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_swing(tmp_path / "x", np.zeros(1, CYCLE), {"speed": float("nan")})
    with pytest.raises(TypeError):
        write_swing(tmp_path / "x", np.zeros(1, CYCLE), {"thing": object()})
    with pytest.raises(TypeError, match="CYCLE"):
        write_swing(tmp_path / "x", np.zeros(3), {})
    assert os.listdir(tmp_path) == []


def test_files_that_are_no_swing_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "swing.parquet"
    with pytest.raises(BenchError, match="no such file"):
        read_swing(path)
    path.write_text("not parquet")
    with pytest.raises(BenchError, match="unreadable"):
        read_swing(path)
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(BenchError, match="without golfbench metadata"):
        read_swing(path)
    for version, message in ((SCHEMA_VERSION - 1, "schema version"), (SCHEMA_VERSION, "tick")):
        metadata = f'{{"schema_version": {version}}}'
        pq.write_table(pa.table({"a": [1]}).replace_schema_metadata({METADATA_KEY: metadata}), path)
        with pytest.raises(BenchError, match=message):
            read_swing(path)


def test_a_truncated_file_is_refused(tmp_path: Path, make_swing: Callable[[int], Cycles]) -> None:
    path = tmp_path / "swing.parquet"
    write_swing(path, make_swing(0), METADATA)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(BenchError, match="unreadable"):
        read_swing(path)


def test_the_bytes_are_on_the_disk_before_the_name_and_the_name_before_it_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a power cut at any of these steps leaves: nothing, a partial file, or the whole one."""
    path, steps = tmp_path / "swing.parquet", []
    real_sync, real_replace = os.fsync, Path.replace

    def sync(descriptor: int) -> None:
        location = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        kind = (
            "folder"
            if location == tmp_path
            else "partial file"
            if ".partial" in location.name
            else location.name
        )
        size = 0 if location == tmp_path else location.stat().st_size
        steps.append((f"sync {kind}", path.exists(), size))
        real_sync(descriptor)

    def rename(self: Path, target: Path) -> Path:
        steps.append(("rename", path.exists(), self.stat().st_size))
        return real_replace(self, target)

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(Path, "replace", rename)
    write_swing(path, np.zeros(100, CYCLE), METADATA)
    size = path.stat().st_size
    assert steps == [("sync partial file", False, size), ("rename", False, size), ("sync folder", True, 0)]


def test_the_files_own_metadata_has_the_unit_of_every_column(tmp_path: Path) -> None:
    write_swing(tmp_path / "swing.parquet", np.zeros(3, CYCLE), {})
    stored = pq.read_metadata(tmp_path / "swing.parquet").metadata
    units = json.loads(stored[b"units"])
    assert list(units) == pq.read_schema(tmp_path / "swing.parquet").names
    assert (units["angle_wrist"], units["plant_effort_arm"]) == ("rad", "N")
