"""The database is made once, keeps its version, refuses what it does not understand, and tells why."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import sqlite3
from contextlib import closing, nullcontext
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import insert, select, text
from sqlalchemy.exc import IntegrityError, StatementError

from bench.base.errors import BenchError
from bench.config import database_url
from bench.store import database as module
from bench.store.database import (
    SCHEMA_VERSION,
    CalibrationRow,
    Row,
    SchemaVersionRow,
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


def test_an_empty_url_is_sqlite_in_the_data_folder(tmp_path: Path) -> None:
    url = database_url("", tmp_path / "new" / "folder")
    assert not is_there(url)
    with open_database(url, NOW):
        pass
    assert (tmp_path / "new" / "folder" / "golfbench.sqlite").exists()
    assert is_there(url)


def test_sqlite_is_set_up_for_several_processes(tmp_path: Path) -> None:
    with open_database(database_url("", tmp_path), NOW) as database, database.connect() as connection:
        assert connection.scalar(text("PRAGMA journal_mode")) == "wal"
        assert connection.scalar(text("PRAGMA foreign_keys")) == 1
        assert connection.scalar(text("PRAGMA synchronous")) == 2
        assert connection.scalar(text("PRAGMA busy_timeout")) == 1000 * module.BUSY_TIMEOUT


def test_the_tables_are_made_once_and_their_version_is_kept(tmp_path: Path) -> None:
    url = database_url("", tmp_path)
    for _ in range(2):
        with open_database(url, NOW) as database, database.connect() as connection:
            found = connection.execute(select(SchemaVersionRow.version, SchemaVersionRow.date)).all()
            assert [tuple(row) for row in found] == [(SCHEMA_VERSION, NOW)]


def _open_and_add(folder: Path, number: int) -> None:
    with open_database(database_url("", folder), NOW) as database, database.begin() as connection:
        connection.execute(insert(CalibrationRow).values(ROW | {"version": number}))


@pytest.mark.live
def test_processes_that_open_a_new_database_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_open_and_add, args=(tmp_path, number)) for number in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
        assert process.exitcode == 0
        process.close()
    with open_database(database_url("", tmp_path), NOW) as database, database.connect() as connection:
        assert sorted(connection.scalars(select(CalibrationRow.version))) == [0, 1, 2]


@pytest.mark.parametrize("version", [SCHEMA_VERSION - 1, SCHEMA_VERSION + 1, -1])
def test_a_database_of_another_golfbench_is_refused_untouched(tmp_path: Path, version: int) -> None:
    url = database_url("", tmp_path)
    with open_database(url, NOW) as database, database.begin() as connection:
        connection.execute(SchemaVersionRow.__table__.update().values(version=version))  # type: ignore[attr-defined]
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
def test_what_is_no_database_of_golfbench_is_told(tmp_path: Path, content: bytes | None, found: str) -> None:
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


@pytest.mark.live
def test_a_locked_database_is_told_after_the_busy_timeout(
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
            connection.execute(insert(CalibrationRow).values(ROW))


@pytest.mark.parametrize("statement", ["UPDATE calibrations SET note = 'better'", "DELETE FROM calibrations"])
def test_the_database_itself_refuses_to_change_a_calibration(tmp_path: Path, statement: str) -> None:
    with open_database(database_url("", tmp_path), NOW) as database:
        with database.begin() as connection:
            connection.execute(insert(CalibrationRow).values(ROW))
        with pytest.raises(IntegrityError, match="only added"), database.begin() as connection:
            connection.execute(text(statement))


def test_a_version_is_given_once(tmp_path: Path) -> None:
    with open_database(database_url("", tmp_path), NOW) as database:
        for already_there in (False, True):
            with pytest.raises(IntegrityError) if already_there else nullcontext(), database.begin() as one:
                one.execute(insert(CalibrationRow).values(ROW))


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a closed database of one calibration, in which nothing may be written."""
    with open_database(database_url("", tmp_path), NOW) as database, database.begin() as connection:
        connection.execute(insert(CalibrationRow).values(ROW))
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    return tmp_path


def test_database_in_an_archive_is_read_and_nothing_is_written_beside_it(archive: Path) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in archive.iterdir()}
    with open_database(database_url("", archive), NOW) as database, database.connect() as connection:
        assert connection.scalar(select(CalibrationRow.by)) == "me"
        assert {path.name: path.stat().st_mtime_ns for path in archive.iterdir()} == before


def test_database_in_an_archive_is_not_changed(archive: Path) -> None:
    with (
        pytest.raises(BenchError, match="attempt to write a readonly database"),
        open_database(database_url("", archive), NOW) as database,
        transaction(database, writes=True) as connection,
    ):
        connection.execute(insert(CalibrationRow).values(ROW | {"version": 2}))


def test_database_in_an_archive_shows_the_changes_in_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_database(database_url("", tmp_path), NOW) as database, database.begin() as connection:
        connection.execute(insert(CalibrationRow).values(ROW))
        connection.commit()
        copy = tmp_path / "copy"
        copy.mkdir()
        for file in tmp_path.glob("golfbench.sqlite*"):
            shutil.copy(file, copy)
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    with open_database(database_url("", copy), NOW) as database, database.connect() as connection:
        assert connection.scalar(select(CalibrationRow.by)) == "me"


def test_times_come_back_in_utc_whatever_zone_they_had(tmp_path: Path) -> None:
    summer = timezone(timedelta(hours=2))
    with open_database(database_url("", tmp_path), NOW) as database:
        with database.begin() as connection:
            connection.execute(insert(CalibrationRow).values(ROW | {"date": NOW.astimezone(summer)}))
        with database.connect() as connection:
            found = connection.scalar(select(CalibrationRow.date))
        assert found == NOW
        assert found.utcoffset() == timedelta(0)
        naive = ROW | {"version": 2, "date": NOW.replace(tzinfo=None)}
        with pytest.raises(StatementError, match="without a zone"), database.begin() as connection:
            connection.execute(insert(CalibrationRow).values(naive))


@pytest.mark.parametrize("url", ["", "sqlite:///{}/other.sqlite"])
def test_a_database_by_url(tmp_path: Path, url: str) -> None:
    with open_database(database_url(url.format(tmp_path), tmp_path), NOW) as database:
        assert set(Row.metadata.tables) <= set(_tables(database))


def _tables(database: Any) -> list[str]:
    with database.connect() as connection:
        return list(connection.scalars(text("SELECT name FROM sqlite_master WHERE type = 'table'")))


@pytest.mark.parametrize("url", ["nonsense://x", "data/golfbench", "sqlite://", "sqlite:///:memory:", "://"])
def test_a_wrong_url_is_refused(tmp_path: Path, url: str) -> None:
    with pytest.raises(BenchError) as refusal:
        database_url(url, tmp_path)
    assert refusal.value.location == "bench.database"


def test_a_missing_driver_is_named_and_no_password_shown(
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
