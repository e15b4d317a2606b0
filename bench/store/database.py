"""One database per bench: SQLite in WAL mode below `data_dir`, or any other by its URL.

The version of the tables stands in them; a database of another version is refused.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import URL, Connection, Engine, create_engine, event, func, inspect, select
from sqlalchemy.exc import DatabaseError, IntegrityError, OperationalError

from bench.errors import BenchError, Refused
from bench.store.tables import Row, SchemaVersionRow

SCHEMA_VERSION = 13
"""Version of `bench.store.tables`."""


BUSY_TIMEOUT = 5.0
"""Time to wait for another process' write, s."""
AWAY_PAUSE = 0.5
"""Time between two attempts to reach the server, s."""

_WRITERS = 20260
"""Number of the writers' lock of a PostgreSQL database."""
_LOCK_TIMEOUT = "55P03"
_AWAY = frozenset({"57P01", "57P02", "57P03", "53300"})
"""PostgreSQL's states while its server shuts down, has crashed, starts, or has no connection left."""


class DatabaseLocked(Refused):
    """Another process holds the database for longer than the time that was waited."""

    state = "locked by another process"
    """How it is, before the time for which it is so."""
    expected_state = "a database that is free to write"
    action = "End the program that holds it (a backup, a database browser), then try again."

    def __init__(self, place: str, waited: float) -> None:
        super().__init__(place, f"{self.state} for {waited:.0f} s", self.expected_state, self.action)
        self.waited = waited
        """Time waited, s."""


class DatabaseAway(DatabaseLocked):
    """The database's server is not there, for longer than the time that was waited."""

    state = "out of reach"
    expected_state = "a server that is up and answers"
    action = "Start the server or mend the way to it, then try again."


def is_busy(error: DatabaseError) -> bool:
    """Return whether `error` says that another process holds the database for now."""
    held = "locked" in str(error.orig) or getattr(error.orig, "sqlstate", None) == _LOCK_TIMEOUT
    return isinstance(error, OperationalError) and held


def is_away(error: DatabaseError) -> bool:
    """Return whether `error` says that the connection to the server is lost, or cannot be made for now."""
    if not isinstance(error, OperationalError) or not hasattr(error.orig, "sqlstate"):
        return False
    state: str | None = getattr(error.orig, "sqlstate", None)
    return state is None or state.startswith("08") or state in _AWAY


@contextmanager
def transaction(
    engine: Engine, *, writes: bool, waiting: Callable[[DatabaseLocked], None] | None = None
) -> Iterator[Connection]:
    """Yield a connection within a transaction; its lock is held from the start.

    `waiting` is called after each `BUSY_TIMEOUT` without the lock, and each `AWAY_PAUSE` without the server,
    with the error to raise to give up; without it the first one ends it.

    Raises:
        DatabaseLocked: another process holds the database, or its server is away.
    """
    began = time.monotonic()
    while True:
        kind = "IMMEDIATE" if writes else "DEFERRED"
        try:
            reached = engine.connect()
        except OperationalError as error:
            if not is_away(error):
                raise
            _wait(DatabaseAway, engine, began, waiting, error)
            time.sleep(AWAY_PAUSE)
            continue
        with reached.execution_options(sqlite_begin=kind) as connection:
            try:
                connection.begin()
                _take_lock(connection, writes)
            except OperationalError as error:
                if not is_busy(error):
                    raise
                _wait(DatabaseLocked, engine, began, waiting, error)
                continue
            yield connection
            connection.commit()
            return


def _take_lock(connection: Connection, writes: bool) -> None:
    """Take the lock now, not at the first query; writers of a server wait for each other as SQLite's do."""
    if connection.dialect.name != "postgresql":
        if not writes:
            connection.scalar(select(func.count()).select_from(SchemaVersionRow))
    elif writes:
        connection.exec_driver_sql(f"SET LOCAL lock_timeout = {round(1000 * BUSY_TIMEOUT)}")
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_WRITERS})")


def _wait(
    kind: type[DatabaseLocked],
    engine: Engine,
    began: float,
    waiting: Callable[[DatabaseLocked], None] | None,
    error: OperationalError,
) -> None:
    """Call `waiting`, or end it without one."""
    trouble = kind(str(engine.url.database), time.monotonic() - began)
    if waiting is None:
        raise trouble from error
    waiting(trouble)


def is_there(url: URL) -> bool:
    """Return whether there may be data to read: a server, or SQLite's file."""
    return url.get_backend_name() != "sqlite" or Path(str(url.database)).exists()


@contextmanager
def open_database(url: URL, now: datetime | None = None) -> Iterator[Engine]:
    """Open the database at `url`, made if need be (dated `now`), and close it.

    Errors of the database within the block become BenchErrors; broken constraints do not.

    Raises:
        BenchError: it cannot be opened, is no golfbench database, or is of another version.
        OSError: its folder cannot be made.
    """
    place = url.render_as_string(hide_password=True)
    read_only = False
    if url.get_backend_name() == "sqlite":
        place = str(url.database)
        Path(place).parent.mkdir(parents=True, exist_ok=True)
        if read_only := is_read_only(Path(place)):
            url = _read_only_url(Path(place))
    try:
        # A connection that a restart of the server has cut is replaced when it is next used.
        pings = url.get_backend_name() != "sqlite"
        engine = create_engine(url, connect_args=_connect_arguments(url), pool_pre_ping=pings)
    except ModuleNotFoundError as error:
        raise BenchError(
            place,
            f"package {error.name} is not installed",
            "the database's driver",
            f"Run pip install {error.name}.",
        ) from error
    if url.get_backend_name() == "sqlite":
        event.listen(engine, "connect", _prepare_reading if read_only else _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
    try:
        _make_tables(engine, place, now or datetime.now(UTC))
        yield engine
    except IntegrityError:
        raise
    except DatabaseError as error:
        if is_busy(error):
            raise DatabaseLocked(place, BUSY_TIMEOUT) from error
        if is_away(error):
            raise DatabaseAway(place, 0.0) from error
        if read_only and _log_of(Path(place)).exists():
            found = f"{str(error.orig).strip()}: read-only, with changes in {_log_of(Path(place)).name}"
            expected = "a database that was closed, or one that can be written"
            action = "Copy its folder to a disk that can be written, and read it there."
            raise BenchError(place, found, expected, action) from error
        expected = "a database of golfbench that can be read and written"
        action = "Check that this user may write to it and its folder, and that the disk has room."
        raise BenchError(place, str(error.orig).strip(), expected, action) from error
    finally:
        engine.dispose()


def is_read_only(file: Path) -> bool:
    """Return whether SQLite's `file` is there and may be read only, as in an archive."""
    return file.exists() and not (os.access(file, os.W_OK) and os.access(file.parent, os.W_OK))


def _read_only_url(file: Path) -> URL:
    """Return the URL that opens `file` without writing beside it.

    Without a log nothing is to be added to the file: SQLite needs no memory shared with writers then.
    """
    log = _log_of(file)
    alone = not log.exists() or not log.stat().st_size
    query = {"mode": "ro", "uri": "true", **({"immutable": "1"} if alone else {})}
    return URL.create("sqlite", database=f"file:{quote(str(file.absolute()))}", query=query)


def _log_of(file: Path) -> Path:
    """Return the write-ahead log of SQLite's `file`."""
    return file.with_name(f"{file.name}-wal")


def _connect_arguments(url: URL) -> dict[str, Any]:
    return {"timeout": BUSY_TIMEOUT} if url.get_backend_name() == "sqlite" else {}


def _prepare_reading(connection: Any, _: Any) -> None:
    connection.isolation_level = None


def _prepare_sqlite(connection: Any, _: Any) -> None:
    """Set what SQLite keeps per connection; its driver's own transactions, which begin late, are off."""
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")  # a shot that is in the database survives a power cut
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    """Begin the transaction; one that writes takes the write lock at once."""
    kind = connection.get_execution_options().get("sqlite_begin", "DEFERRED")
    connection.exec_driver_sql(f"BEGIN {kind}")


def _make_tables(engine: Engine, place: str, now: datetime) -> None:
    """Make the tables of an empty database; refuse one of another version."""
    with engine.connect() as connection:
        if _has_tables(connection, place):
            return
    with engine.connect().execution_options(sqlite_begin="IMMEDIATE") as connection, connection.begin():
        if not _has_tables(connection, place):  # another process may have been faster
            Row.metadata.create_all(connection)
            made = SchemaVersionRow.__table__.insert()  # type: ignore[attr-defined]
            connection.execute(made.values(version=SCHEMA_VERSION, date=now))


def _has_tables(connection: Connection, place: str) -> bool:
    """Return whether the tables are there, in SCHEMA_VERSION; raises BenchError if they are others."""
    tables = inspect(connection).get_table_names()
    if not tables:
        return False
    if SchemaVersionRow.__tablename__ not in tables:
        found = f"tables {', '.join(sorted(tables)[:5])}, but no {SchemaVersionRow.__tablename__}"
        raise BenchError(
            place, found, "a database of golfbench, or an empty one", "Set bench.database to another one."
        )
    version = connection.scalar(select(func.max(SchemaVersionRow.version)))
    if version != SCHEMA_VERSION:
        action = "Use the version of golfbench that wrote it, or name another database: bench.database."
        raise BenchError(place, f"schema version {version}", f"version {SCHEMA_VERSION}", action)
    return True
