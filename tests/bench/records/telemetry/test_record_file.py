from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bench.base.atomic_file import NotStored, atomic_file
from bench.base.errors import BenchError
from bench.base.lifecycle import Cause
from bench.records.telemetry.cycle_record import CYCLE, SCHEMA_VERSION
from bench.records.telemetry.record_file import METADATA_KEY, read_swing, record_files, write_swing

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


def test_read_swing_restores_written_swing_bit_for_bit(
    tmp_path: Path, make_swing: Callable[[int], Cycles]
) -> None:
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


def test_write_swing_same_input_gives_same_bytes(tmp_path: Path, make_swing: Callable[[int], Cycles]) -> None:
    for name in ("a", "b"):
        write_swing(tmp_path / name, make_swing(2), METADATA)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_write_swing_loads_no_pandas(tmp_path: Path) -> None:
    code = (
        "import sys, numpy as np\nfrom pathlib import Path\n"
        "from bench.records.telemetry.record_file import CYCLE, write_swing\n"
        f"write_swing(Path({str(tmp_path / 'swing.parquet')!r}), np.zeros(3, CYCLE), {{}})\n"
        "assert 'pyarrow' in sys.modules and 'pandas' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_write_swing_stores_no_name_of_unknown_code(tmp_path: Path) -> None:
    cycles = np.zeros(4, CYCLE)
    cycles["cause"] = [0, -7, 1 << 20, Cause.EMERGENCY_STOP]
    write_swing(tmp_path / "swing.parquet", cycles, {})
    names = pq.read_table(tmp_path / "swing.parquet").column("cause_name").to_pylist()
    assert names == ["NONE", None, None, "EMERGENCY_STOP"]


def test_write_swing_stores_plain_columns_with_units(
    tmp_path: Path, make_swing: Callable[[int], Cycles]
) -> None:
    write_swing(tmp_path / "swing.parquet", make_swing(0), METADATA)
    table = pq.read_table(tmp_path / "swing.parquet", columns=["time", "angle_wrist", "ball_present"])
    assert table.schema.field("angle_wrist").metadata[b"unit"] == b"rad"
    assert table.schema.field("ball_present").type == pa.bool_()
    assert table.num_rows == 2100


def test_write_swing_full_disk_raises_error_and_keeps_old_file(
    tmp_path: Path, make_swing: Callable[[int], Cycles]
) -> None:
    path = tmp_path / "swing.parquet"
    path.write_bytes(b"before")
    with largest_file(20_000), pytest.raises(BenchError, match="nothing was stored"):
        write_swing(path, make_swing(0), METADATA)
    assert os.listdir(tmp_path) == ["swing.parquet"]
    assert path.read_bytes() == b"before"


def test_write_swing_unwritable_folder_raises_error(tmp_path: Path) -> None:
    for folder in (tmp_path / "absent", Path("/proc")):
        with pytest.raises(BenchError, match="folder that can be written"):
            write_swing(folder / "swing.parquet", np.zeros(1, CYCLE), {})


def test_write_swing_read_only_folder_raises_error(tmp_path: Path) -> None:
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


def test_atomic_file_interrupt_leaves_no_file(tmp_path: Path) -> None:
    def interrupted() -> None:
        with atomic_file(tmp_path / "report.html") as stream:
            stream.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert os.listdir(tmp_path) == []


def test_atomic_file_folder_or_pipe_is_refused_and_stays(tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "pipe")
    for place in (pipe, tmp_path, Path(".."), Path("/"), Path(os.devnull)):
        with pytest.raises(NotStored, match="found a folder, device or pipe"), atomic_file(place):
            pass
    assert pipe.is_fifo()
    assert os.listdir(tmp_path) == ["pipe"]


def test_atomic_file_link_keeps_link_and_replaces_target(tmp_path: Path) -> None:
    (folder := tmp_path / "shared").mkdir()
    (folder / "page.html").write_text("old")
    (link := tmp_path / "report.html").symlink_to(folder / "page.html")
    with atomic_file(link) as stream:
        stream.write(b"new")
    assert link.is_symlink()
    assert (folder / "page.html").read_text() == "new"
    assert os.listdir(folder) == ["page.html"]


def test_write_swing_invalid_metadata_or_cycles_raise_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_swing(tmp_path / "x", np.zeros(1, CYCLE), {"speed": float("nan")})
    with pytest.raises(TypeError):
        write_swing(tmp_path / "x", np.zeros(1, CYCLE), {"thing": object()})
    with pytest.raises(TypeError, match="CYCLE"):
        write_swing(tmp_path / "x", np.zeros(3), {})
    assert os.listdir(tmp_path) == []


def test_read_swing_missing_or_foreign_file_is_refused(tmp_path: Path) -> None:
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


def test_read_swing_folder_is_refused(tmp_path: Path, make_swing: Callable[[int], Cycles]) -> None:
    for number in (1, 2):
        write_swing(tmp_path / f"{number}.parquet", make_swing(number), {"kind": "swing"})
    with pytest.raises(BenchError, match="a folder"):
        read_swing(tmp_path)


def test_read_swing_truncated_file_is_refused(tmp_path: Path, make_swing: Callable[[int], Cycles]) -> None:
    path = tmp_path / "swing.parquet"
    write_swing(path, make_swing(0), METADATA)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(BenchError, match="unreadable"):
        read_swing(path)


def test_write_swing_syncs_file_before_rename_and_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut at any of these steps leaves nothing, a partial file, or the complete one."""
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


def test_write_swing_metadata_has_unit_of_every_column(tmp_path: Path) -> None:
    write_swing(tmp_path / "swing.parquet", np.zeros(3, CYCLE), {})
    stored = pq.read_metadata(tmp_path / "swing.parquet").metadata
    units = json.loads(stored[b"units"])
    assert list(units) == pq.read_schema(tmp_path / "swing.parquet").names
    assert (units["angle_wrist"], units["plant_effort_arm"]) == ("rad", "N")


def test_record_files_accepts_folders_and_files(tmp_path: Path) -> None:
    for name in ("b/2.parquet", "b/1.parquet", "a.parquet", "b/x.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [p.name for p in record_files([tmp_path / "b", tmp_path / "a.parquet"])] == [
        "1.parquet",
        "2.parquet",
        "a.parquet",
    ]
    with pytest.raises(BenchError, match="no such file"):
        record_files([tmp_path / "c"])
    with pytest.raises(BenchError, match="no record"):
        record_files([])
