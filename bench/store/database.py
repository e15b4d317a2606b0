"""One database per bench: SQLite in WAL mode below `data_dir`, or any other by its URL; its tables.

The version of the tables, `SCHEMA_VERSION`, is stored in them and changes with them; a database of another
version is refused.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from math import ceil
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_type_hints
from urllib.parse import quote

from sqlalchemy import (
    DDL,
    JSON,
    URL,
    Boolean,
    Column,
    Connection,
    DateTime,
    Dialect,
    Double,
    Engine,
    ForeignKey,
    Integer,
    MetaData,
    String,
    Table,
    UniqueConstraint,
    create_engine,
    event,
    false,
    func,
    insert,
    inspect,
    select,
)
from sqlalchemy.exc import DatabaseError, IntegrityError, OperationalError
from sqlalchemy.types import TypeDecorator

from bench.base.errors import BenchError, ExitCode, Refused
from bench.records.shot.shot import Shot
from bench.store.rows import (
    AirReading,
    BallAerodynamicsRow,
    CalibrationRow,
    CampaignEntry,
    CampaignRun,
    Event,
    Hit,
    LearnedSwingRow,
    Prompt,
    ShotExclusion,
    ShotNote,
    Standing,
)


class UtcTime(TypeDecorator[datetime]):
    """An instant: UTC in the database, aware in Python. SQLite stores no zone."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return `value` in UTC; ValueError when it has no zone."""
        if value is not None and value.tzinfo is None:
            raise ValueError(f"a time without a zone: {value!r}")
        return None if value is None else value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return the stored time as an aware one."""
        return None if value is None else value.replace(tzinfo=value.tzinfo or UTC).astimezone(UTC)


METADATA = MetaData()

SCHEMA = Table(
    "schema_version",
    METADATA,
    Column("version", Integer, primary_key=True, autoincrement=False),
    Column("date", UtcTime, nullable=False),
)
"""The version of the tables, in one row."""

_TYPES = {int: Integer, float: Double, bool: Boolean, datetime: UtcTime, Mapping[str, Any]: JSON}
"""Type of a column by that of its field; others, texts and codes, are String."""


def _columns(record: type, *key: str) -> Iterator[Column[Any]]:
    """Yield a column for each field of `record`; those in `key` identify a row."""
    for name, hint in get_type_hints(record).items():
        optional = isinstance(hint, UnionType)
        kind = _TYPES.get(get_args(hint)[0] if optional else hint, String)
        yield Column(name, kind, primary_key=name in key, autoincrement=False, nullable=optional)


def _of_campaign(name: str, record: type, *key: str, more: Iterable[Column[Any]] = ()) -> Table:
    """Return a table of `record`s of campaigns, by the fields in `key`; without any by a number."""
    number = [] if key else [Column("id", Integer, primary_key=True)]
    campaign: Column[str] = Column(
        "campaign", ForeignKey("campaigns.id"), primary_key=bool(key), index=not key
    )
    return Table(name, METADATA, *number, campaign, *_columns(record, *key), *more)


CAMPAIGNS = Table(
    "campaigns",
    METADATA,
    *_columns(CampaignEntry, "id"),
    *_columns(Standing),
    Column("number", Integer, nullable=False),
)
"""The number rises by one per campaign: the order of their starts, regardless of the clock."""

SHOTS = _of_campaign(
    "shots",
    Shot,
    "shot",
    more=(
        Column("file", String, nullable=False),
        Column("bytes", Integer, nullable=False),
        Column("set_aside", Boolean, nullable=False, server_default=false()),
    ),
)
"""Shots. `file`, below `data_dir`, has the record of a shot's cycles, whole before its row exists, and
`bytes` its size; empty: the robot did not swing. Set aside: its block was restarted after it; it is kept and
excluded."""

EVENTS = _of_campaign("campaign_events", Event)
RUNS = _of_campaign("campaign_runs", CampaignRun, "number")
NOTES = _of_campaign("shot_notes", ShotNote)
"""Rows are only added."""
EXCLUSIONS = _of_campaign("shot_exclusions", ShotExclusion)
"""Rows are only added; the shot's row stays."""
PROMPTS = _of_campaign(
    "campaign_prompts", Prompt, "number", more=[Column("answer", Integer, nullable=False, server_default="0")]
)
"""`answer` counts the answers, so that their order does not depend on the clock; 0 until answered."""

HITS = Table(
    "hit_counts",
    METADATA,
    Column("scope", String, primary_key=True),
    *_columns(Hit, *Hit._fields),
    Column("hits", Integer, nullable=False),
)
"""Number of uses of a ball, a club, a valve, in the `CampaignEntry.hit_scope`."""

WRITERS = Table(
    "writers", METADATA, Column("id", String, primary_key=True), Column("writes", Integer, nullable=False)
)
"""Number of the last stored write, from 1, of each program that repeats writes of unknown success."""


def _append_only(name: str, record: type, *versioned: str) -> Table:
    """Return a table of `record`s, whose versions rise by one per value of the columns `versioned`.

    The database itself refuses to change or delete its rows.
    """
    number = Column("id", Integer, primary_key=True)
    unique = [UniqueConstraint(*versioned, "version")] if versioned else []
    table = Table(name, METADATA, number, *_columns(record), *unique)
    for action in ("UPDATE", "DELETE"):
        trigger = DDL(  # type: ignore[no-untyped-call]
            f"CREATE TRIGGER {name}_no_{action.lower()} BEFORE {action} ON {name} "
            f"BEGIN SELECT RAISE(ABORT, '{name.replace('_', ' ')} are only added'); END"
        ).execute_if(dialect="sqlite")
        event.listen(table, "after_create", trigger)
    return table


CALIBRATIONS = _append_only("calibrations", CalibrationRow, "bench", "kind")
LEARNED_SWINGS = _append_only("learned_swings", LearnedSwingRow, "bench", "profile")
AIR_READINGS = _append_only("air_readings", AirReading)
BALL_AERODYNAMICS = _append_only("ball_aerodynamics", BallAerodynamicsRow, "bench", "ball")

SCHEMA_VERSION = 16


BUSY_TIMEOUT = 5.0
"""Time to wait for another process' write, or for a server's answer to a connection, s."""
AWAY_PAUSE = 0.5
"""Time between two attempts to reach the server, s."""

_WRITERS = 20260
"""Key of the writers' lock of a PostgreSQL database."""
_LOCK_TIMEOUT = "55P03"
_AWAY = frozenset({"57P01", "57P02", "57P03", "53300"})
"""PostgreSQL's states while its server shuts down, has crashed, starts, or has no connection left."""


class DatabaseLocked(Refused):
    """Another process holds the database for longer than the time that was waited."""

    state = "locked by another process"
    """State of the database, which a message states before its duration."""
    expected_state = "a database that is free to write"
    action = "End the program that holds it (a backup, a database browser), then try again."

    def __init__(self, location: str, waited: float) -> None:
        found = f"{self.state} for {waited:.0f} s" if waited else self.state
        super().__init__(location, found, self.expected_state, self.action)
        self.waited = waited
        """Waiting time (s)."""


class DatabaseAway(DatabaseLocked):
    """The database's server is unreachable for longer than the waiting time."""

    exit_code = ExitCode.DEVICE
    state = "out of reach"
    expected_state = "a server that is up and answers"
    action = "Start the server or restore the connection to it, then retry."


_DAMAGED = ("SQLITE_CORRUPT", "SQLITE_NOTADB")
"""First letters of SQLite's errors about the content of a file."""


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

    `waiting` is called with an error after each `BUSY_TIMEOUT` without the lock and each `AWAY_PAUSE` without
    the server; it raises the error to give up. Without `waiting` the first error is raised.

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
            connection.scalar(select(func.count()).select_from(SCHEMA))
    elif writes:
        connection.exec_driver_sql(f"SET LOCAL lock_timeout = {round(1000 * BUSY_TIMEOUT)}")
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_WRITERS})")


def add_version(connection: Connection, table: Table, key: str, row: Mapping[str, Any]) -> int:
    """Add `row` to an append-only table as the next version of its bench and `key`; return that version.

    `connection` holds the write lock, see `transaction`.
    """
    c = table.c
    mine = (c.bench == row["bench"]) & (c[key] == row[key])
    version = int(connection.scalar(select(func.max(c.version)).where(mine)) or 0) + 1
    connection.execute(insert(table).values(**row, version=version))
    return version


def _wait(
    kind: type[DatabaseLocked],
    engine: Engine,
    began: float,
    waiting: Callable[[DatabaseLocked], None] | None,
    error: OperationalError,
) -> None:
    """Call `waiting`, or end it without one."""
    locked = kind(str(engine.url.database), time.monotonic() - began)
    if waiting is None:
        raise locked from error
    waiting(locked)


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
    location = url.render_as_string(hide_password=True)
    is_sqlite, read_only = url.get_backend_name() == "sqlite", False
    if is_sqlite:
        location = str(url.database)
        Path(location).parent.mkdir(parents=True, exist_ok=True)
        if read_only := is_read_only(Path(location)):
            url = _read_only_url(Path(location))
    try:
        # A connection that a restart of the server has cut is replaced when it is next used.
        arguments: dict[str, float] = {"timeout": BUSY_TIMEOUT} if is_sqlite else {}
        if (
            url.get_backend_name() == "postgresql" and "connect_timeout" not in url.query
        ):  # whose driver takes whole seconds, and waits for minutes
            arguments["connect_timeout"] = ceil(BUSY_TIMEOUT)
        engine = create_engine(url, connect_args=arguments, pool_pre_ping=not is_sqlite)
    except ModuleNotFoundError as error:
        found, action = f"package {error.name} is not installed", f"Run pip install {error.name}."
        raise BenchError(location, found, "the database's driver", action) from error
    if is_sqlite:
        event.listen(engine, "connect", _prepare_reading if read_only else _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
    try:
        _make_tables(engine, location, now or datetime.now(UTC))
        yield engine
    except IntegrityError:
        raise
    except DatabaseError as error:
        raise _fault_of(error, location, read_only=read_only) from error
    finally:
        engine.dispose()


def _fault_of(error: DatabaseError, location: str, *, read_only: bool) -> BenchError:
    """Return `error` of the database at `location` as a BenchError with an action."""
    if is_busy(error):
        return DatabaseLocked(location, BUSY_TIMEOUT)
    if is_away(error):
        return DatabaseAway(location, 0.0)
    found, is_file_fault = str(error.orig).strip(), isinstance(error, OperationalError)
    expected = "a database of golfbench that can be read and written"
    action = "Check that this user may write to it and its folder, and that the disk has room."
    if getattr(error.orig, "sqlite_errorname", "").startswith(_DAMAGED):
        found, expected, is_file_fault = f"damaged: {found}", "an intact SQLite database of golfbench", True
        action = f"Restore a copy of it, save its rows by sqlite3 {location} .recover, or set bench.database."
    elif read_only and _log_of(Path(location)).exists():
        found = f"{found}: read-only, with changes in {_log_of(Path(location)).name}"
        expected = "a database that was closed cleanly, or write access to it"
        action = "Copy its folder to a disk that can be written, and read it there."
        is_file_fault = False
    code = ExitCode.FILE if is_file_fault else None
    return BenchError(location, found, expected, action, code=code)


def is_read_only(file: Path) -> bool:
    """Return whether SQLite's `file` is there and may be read only, as in an archive."""
    return file.exists() and not (os.access(file, os.W_OK) and os.access(file.parent, os.W_OK))


def _read_only_url(file: Path) -> URL:
    """Return the URL that opens `file` without writing to its folder.

    Without a write-ahead log (WAL) nothing is left to checkpoint: SQLite needs no memory shared with writers.
    """
    log = _log_of(file)
    alone = not log.exists() or not log.stat().st_size
    query = {"mode": "ro", "uri": "true", **({"immutable": "1"} if alone else {})}
    return URL.create("sqlite", database=f"file:{quote(str(file.absolute()))}", query=query)


def _log_of(file: Path) -> Path:
    return file.with_name(f"{file.name}-wal")


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


def _make_tables(engine: Engine, location: str, now: datetime) -> None:
    with engine.connect() as connection:
        if _has_tables(connection, location):
            return
    with engine.connect().execution_options(sqlite_begin="IMMEDIATE") as connection, connection.begin():
        if not _has_tables(connection, location):  # another process may have been faster
            METADATA.create_all(connection)
            connection.execute(insert(SCHEMA).values(version=SCHEMA_VERSION, date=now))


def _has_tables(connection: Connection, location: str) -> bool:
    """Return whether the tables exist in SCHEMA_VERSION; BenchError if in a different one."""
    tables = inspect(connection).get_table_names()
    if not tables:
        return False
    if SCHEMA.name not in tables:
        found = f"tables {', '.join(sorted(tables)[:5])}, but no {SCHEMA.name}"
        expected = "a database of golfbench, or an empty one"
        raise BenchError(location, found, expected, "Set bench.database to another one.")
    version = connection.scalar(select(func.max(SCHEMA.c.version)))
    if version != SCHEMA_VERSION:
        action = "Use the version of golfbench that wrote it, or name another database: bench.database."
        raise BenchError(location, f"schema version {version}", f"version {SCHEMA_VERSION}", action)
    return True
