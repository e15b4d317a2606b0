"""The database is created once, keeps its version, and refuses unknown contents with a reason."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import socket
import sqlite3
import time
from contextlib import closing, nullcontext
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import insert, select, text
from sqlalchemy.exc import IntegrityError, StatementError

from bench.base.errors import BenchError, ExitCode
from bench.config import database_url
from bench.store import database as module
from bench.store.database import (
    CALIBRATIONS,
    METADATA,
    SCHEMA,
    SCHEMA_VERSION,
    is_there,
    open_database,
    transaction,
)

NOW = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)
ROW: dict[str, Any] = {
    "bench": "b",
    "kind": "ball",
    "version": 1,
    "subject": "",
    "date": NOW,
    "expires": NOW + timedelta(days=1),
    "by": "me",
    "method": "rule",
    "note": "",
    "content": {"x": 1.0},
}


def test_database_url_empty_creates_sqlite_in_data_folder(tmp_path: Path) -> None:
    url = database_url("", tmp_path / "new" / "folder")
    assert not is_there(url)
    with open_database(url, NOW):
        pass
    assert (tmp_path / "new" / "folder" / "golfbench.sqlite").exists()
    assert is_there(url)


def test_open_database_sqlite_sets_multiprocess_pragmas(tmp_path: Path) -> None:
    with open_database(database_url("", tmp_path), NOW) as database, database.connect() as connection:
        assert connection.scalar(text("PRAGMA journal_mode")) == "wal"
        assert connection.scalar(text("PRAGMA foreign_keys")) == 1
        assert connection.scalar(text("PRAGMA synchronous")) == 2
        assert connection.scalar(text("PRAGMA busy_timeout")) == 1000 * module.BUSY_TIMEOUT


def test_open_database_second_open_keeps_schema_version(tmp_path: Path) -> None:
    url = database_url("", tmp_path)
    for _ in range(2):
        with open_database(url, NOW) as database, database.connect() as connection:
            found = connection.execute(select(SCHEMA.c.version, SCHEMA.c.date)).all()
            assert [tuple(row) for row in found] == [(SCHEMA_VERSION, NOW)]


def _open_and_add(folder: Path, number: int) -> None:
    with open_database(database_url("", folder), NOW) as database, database.begin() as connection:
        connection.execute(insert(CALIBRATIONS).values(ROW | {"version": number}))


@pytest.mark.live
def test_open_database_concurrent_first_open_keeps_every_row(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_open_and_add, args=(tmp_path, number)) for number in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
        assert process.exitcode == 0
        process.close()
    with open_database(database_url("", tmp_path), NOW) as database, database.connect() as connection:
        assert sorted(connection.scalars(select(CALIBRATIONS.c.version))) == [0, 1, 2]


@pytest.mark.parametrize("version", [SCHEMA_VERSION - 1, SCHEMA_VERSION + 1, -1])
def test_open_database_other_schema_version_is_refused_unchanged(tmp_path: Path, version: int) -> None:
    url = database_url("", tmp_path)
    with open_database(url, NOW) as database, database.begin() as connection:
        connection.execute(SCHEMA.update().values(version=version))
    with pytest.raises(BenchError) as refusal, open_database(url, NOW):
        pass
    assert str(version) in refusal.value.found
    assert refusal.value.expected == f"version {SCHEMA_VERSION}"
    assert "bench.database" in refusal.value.action
    with closing(sqlite3.connect(tmp_path / "golfbench.sqlite")) as plain:
        assert plain.execute("SELECT version FROM schema_version").fetchall() == [(version,)]


@pytest.mark.parametrize(
    ("content", "found"),
    [(b"no database at all, but long enough to have a header" * 20, "not a database"), (None, "tables cats")],
)
def test_open_database_foreign_file_is_refused(tmp_path: Path, content: bytes | None, found: str) -> None:
    file = tmp_path / "golfbench.sqlite"
    if content is None:
        with closing(sqlite3.connect(file)) as plain:
            plain.execute("CREATE TABLE cats (name TEXT)")
    else:
        file.write_bytes(content)
    with pytest.raises(BenchError) as refusal, open_database(database_url("", tmp_path), NOW):
        pass
    assert str(file) == refusal.value.location
    assert found in refusal.value.found


@pytest.mark.parametrize("whole", [True, False])
def test_open_database_damaged_file_names_damage(tmp_path: Path, whole: bool) -> None:
    url, file = database_url("", tmp_path), tmp_path / "golfbench.sqlite"
    with open_database(url, NOW):
        pass
    content = file.read_bytes()
    file.write_bytes(b"x" * len(content) if whole else content[:4096] + b"x" * (len(content) - 4096))
    with pytest.raises(BenchError) as refusal, open_database(url, NOW):
        pass
    assert (refusal.value.exit_code, refusal.value.found[:9]) == (ExitCode.FILE, "damaged: ")
    assert ".recover" in refusal.value.action


@pytest.mark.live
def test_open_database_locked_raises_after_busy_timeout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BUSY_TIMEOUT", 0.05)
    url = database_url("", tmp_path)
    with open_database(url, NOW):
        pass
    with closing(sqlite3.connect(tmp_path / "golfbench.sqlite", isolation_level=None)) as plain:
        plain.execute("BEGIN IMMEDIATE")
        with (
            pytest.raises(BenchError, match="locked"),
            open_database(url, NOW) as database,
            database.begin() as connection,
        ):
            connection.execute(insert(CALIBRATIONS).values(ROW))


@pytest.mark.parametrize("statement", ["UPDATE calibrations SET note = 'better'", "DELETE FROM calibrations"])
def test_calibration_table_update_or_delete_is_refused(tmp_path: Path, statement: str) -> None:
    with open_database(database_url("", tmp_path), NOW) as database:
        with database.begin() as connection:
            connection.execute(insert(CALIBRATIONS).values(ROW))
        with pytest.raises(IntegrityError, match="only added"), database.begin() as connection:
            connection.execute(text(statement))


def test_calibration_table_duplicate_version_is_refused(tmp_path: Path) -> None:
    with open_database(database_url("", tmp_path), NOW) as database:
        for already_there in (False, True):
            with pytest.raises(IntegrityError) if already_there else nullcontext(), database.begin() as one:
                one.execute(insert(CALIBRATIONS).values(ROW))


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a closed database of one calibration, in which nothing may be written."""
    with open_database(database_url("", tmp_path), NOW) as database, database.begin() as connection:
        connection.execute(insert(CALIBRATIONS).values(ROW))
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    return tmp_path


def test_read_only_database_read_writes_no_file(archive: Path) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in archive.iterdir()}
    with open_database(database_url("", archive), NOW) as database, database.connect() as connection:
        assert connection.scalar(select(CALIBRATIONS.c.by)) == "me"
        assert {path.name: path.stat().st_mtime_ns for path in archive.iterdir()} == before


def test_read_only_database_write_is_refused(archive: Path) -> None:
    with (
        pytest.raises(BenchError, match="attempt to write a readonly database") as refused,
        open_database(database_url("", archive), NOW) as database,
        transaction(database, writes=True) as connection,
    ):
        connection.execute(insert(CALIBRATIONS).values(ROW | {"version": 2}))
    assert refused.value.exit_code == ExitCode.FILE


def test_read_only_database_reads_changes_from_wal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_database(database_url("", tmp_path), NOW) as database, database.begin() as connection:
        connection.execute(insert(CALIBRATIONS).values(ROW))
        connection.commit()
        copy = tmp_path / "copy"
        copy.mkdir()
        for file in tmp_path.glob("golfbench.sqlite*"):
            shutil.copy(file, copy)
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    with open_database(database_url("", copy), NOW) as database, database.connect() as connection:
        assert connection.scalar(select(CALIBRATIONS.c.by)) == "me"


def test_database_time_returns_in_utc_and_naive_is_refused(tmp_path: Path) -> None:
    summer = timezone(timedelta(hours=2))
    with open_database(database_url("", tmp_path), NOW) as database:
        with database.begin() as connection:
            connection.execute(insert(CALIBRATIONS).values(ROW | {"date": NOW.astimezone(summer)}))
        with database.connect() as connection:
            found = connection.scalar(select(CALIBRATIONS.c.date))
        assert found == NOW
        assert found.utcoffset() == timedelta(0)
        naive = ROW | {"version": 2, "date": NOW.replace(tzinfo=None)}
        with pytest.raises(StatementError, match="without a zone"), database.begin() as connection:
            connection.execute(insert(CALIBRATIONS).values(naive))


@pytest.mark.parametrize("url", ["", "sqlite:///{}/other.sqlite"])
def test_open_database_by_url_creates_every_table(tmp_path: Path, url: str) -> None:
    with open_database(database_url(url.format(tmp_path), tmp_path), NOW) as database:
        assert set(METADATA.tables) <= set(_tables(database))


def _tables(database: Any) -> list[str]:
    with database.connect() as connection:
        return list(connection.scalars(text("SELECT name FROM sqlite_master WHERE type = 'table'")))


@pytest.mark.parametrize("url", ["nonsense://x", "data/golfbench", "sqlite://", "sqlite:///:memory:", "://"])
def test_database_url_invalid_is_refused(tmp_path: Path, url: str) -> None:
    with pytest.raises(BenchError) as refusal:
        database_url(url, tmp_path)
    assert refusal.value.location == "bench.database"


def test_open_database_server_away_is_device_error(tmp_path: Path) -> None:
    pytest.importorskip("psycopg")
    url = database_url("postgresql+psycopg://127.0.0.1:1/golf", tmp_path)
    with pytest.raises(module.DatabaseAway) as refusal, open_database(url, NOW):
        pass
    assert refusal.value.exit_code == ExitCode.DEVICE


def test_open_database_silent_server_times_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("psycopg")
    monkeypatch.setattr(module, "BUSY_TIMEOUT", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port, began = silent.getsockname()[1], time.monotonic()
        url = database_url(f"postgresql+psycopg://127.0.0.1:{port}/golf", tmp_path)
        with pytest.raises(module.DatabaseAway), open_database(url, NOW):
            pass
    assert time.monotonic() - began < 10.0


def test_open_database_missing_driver_names_package_and_hides_password(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(*_: object, **__: object) -> None:
        raise ModuleNotFoundError("no", name="psycopg")

    monkeypatch.setattr(module, "create_engine", missing)
    url = database_url("postgresql+psycopg://me:secret@host/golf", tmp_path)
    with pytest.raises(BenchError) as refusal, open_database(url, NOW):
        pass
    assert "psycopg" in refusal.value.found
    assert "secret" not in str(refusal.value)
