"""Calibrations and aerodynamics of balls in the bench's database: added, listed, never changed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict
from datetime import datetime, timedelta
from typing import Any, TypeVar

from sqlalchemy import ColumnElement, Connection, Engine, Select, Table, literal, select

from bench.base.errors import BenchError
from bench.base.from_toml import checked_values
from bench.calibration.ball_aerodynamics import AerodynamicsEntry, BallAerodynamics
from bench.calibration.calibration import (
    VALID_DAYS,
    Calibration,
    CalibrationKind,
    ClubInMount,
    Entry,
    UnreadableEntry,
    Values,
    content_of,
    kind_of,
    values_of,
)
from bench.config import Configuration, database_url
from bench.store.database import (
    BALL_AERODYNAMICS,
    CALIBRATIONS,
    add_version,
    is_there,
    open_database,
    transaction,
)


def keep_calibration(
    configuration: Configuration,
    values: Values,
    now: datetime,
    *,
    by: str,
    method: str,
    note: str = "",
    days: int | None = None,
) -> Entry:
    """Store `values` for the bench of `configuration` from `now` on, for `days` or their default.

    Raises:
        BenchError: as `add_calibration`, or the database cannot be opened.
    """
    bench, expires = configuration.bench, now + timedelta(days=days or VALID_DAYS[kind_of(values)])
    with open_database(database_url(bench.database, bench.data_dir), now) as database:
        return add_calibration(
            database, bench.id, values, date=now, expires=expires, by=by, method=method, note=note
        )


def add_calibration(
    database: Engine,
    bench: str,
    values: Values,
    *,
    date: datetime,
    expires: datetime,
    by: str,
    method: str,
    note: str = "",
) -> Entry:
    """Store `values` as the next version of their kind and return the entry.

    Raises:
        BenchError: it expires before it begins, or `by` or `method` is empty.
    """
    kind = kind_of(values)
    for name, found in (("by", by), ("method", method)):
        if not found.strip():
            raise BenchError(f"calibrate {kind}: --{name}", "missing", "a text", f"Add --{name} with a text.")
    if not date < expires:
        raise BenchError(
            f"calibrate {kind}: expires", f"{expires}", f"later than {date}", "Give it a later day."
        )
    row = {
        "bench": bench,
        "kind": kind.value,
        "subject": values.club if isinstance(values, ClubInMount) else "",
        "date": date,
        "expires": expires,
        "by": by.strip(),
        "method": method.strip(),
        "note": note.strip(),
        "content": content_of(values),
    }
    c = CALIBRATIONS.c
    with transaction(database, writes=True) as connection:
        version = add_version(connection, CALIBRATIONS, "kind", row)
        mine = (c.bench == bench) & (c.kind == kind.value) & (c.version == version)
        return _entry(connection.execute(select(CALIBRATIONS).where(mine)).one())


def list_calibrations(database: Engine, bench: str) -> list[Entry | UnreadableEntry]:
    """Return all calibrations of `bench` in the order in which they were entered."""
    c = CALIBRATIONS.c
    return _stored(database, CALIBRATIONS, bench, (c.kind, c.subject), _entry)


_Read = TypeVar("_Read")


def _stored(
    database: Engine,
    table: Table,
    bench: str,
    names: tuple[ColumnElement[str], ColumnElement[str]],
    read: Callable[[Any], _Read],
) -> list[_Read | UnreadableEntry]:
    """Return what `read` makes of each row of `bench`; `names` are the columns of kind and subject."""
    c = table.c
    rows = select(table).where(c.bench == bench)
    places = select(c.id, c.version, *names).where(c.bench == bench).order_by(c.id)
    found = list[_Read | UnreadableEntry]()
    with database.connect() as connection:
        places_found = connection.execute(places).all()
        parsed = _parsed(connection, rows)
        for number, version, kind, subject in places_found:
            try:
                row = parsed.get(number) or connection.execute(rows.where(c.id == number)).one()
                found.append(read(row))
            except (ValueError, TypeError, AttributeError, ExceptionGroup) as error:
                found.append(UnreadableEntry(kind, version, subject, _reason(error)))
    return found


def _reason(error: Exception) -> str:
    """Return the mistakes in a row, without its place."""
    mistakes = error.exceptions if isinstance(error, ExceptionGroup) else (error,)
    return "; ".join(
        f"{one.location.rpartition(': ')[2]} is {one.found}, expected {one.expected}"
        if isinstance(one, BenchError)
        else str(one)
        for one in mistakes
    )


def _parsed(connection: Connection, rows: Select[Any]) -> dict[int, Any]:
    """Return the rows by number; none if a date or JSON in one of them cannot be parsed."""
    try:
        return {row.id: row for row in connection.execute(rows)}
    except (ValueError, TypeError):
        return {}


def effective_calibration(
    database: Engine,
    bench: str,
    when: datetime,
    *,
    club: str = "",
    required: bool = False,
    tee_of: Callable[[str], object] = lambda club: None,
) -> Calibration:
    """Return the calibrations in force on `bench` at `when` with `club` mounted: the last of each kind.

    The order of entry counts: a calibration whose date was ahead of the clock does not stay the newest.
    `required` says that a kind without a calibration is a problem (a machine), not nominal (simulation).
    `tee_of` returns the place of a club's tee; the newest calibration of the tee holds at its place only.
    """
    newest: dict[str, Entry] = {}
    later: dict[str, Entry] = {}
    unreadable: dict[str, UnreadableEntry] = {}
    for entry in list_calibrations(database, bench):
        if entry.subject not in {"", club}:
            continue
        if isinstance(entry, UnreadableEntry):
            newest.pop(entry.kind, None)
            unreadable[entry.kind] = entry
        elif entry.date <= when:
            newest[entry.kind] = entry
            later.pop(entry.kind, None)
            unreadable.pop(entry.kind, None)
        else:
            later[entry.kind] = entry
    moved = newest.get(CalibrationKind.BALL)
    if moved is None or tee_of(getattr(moved.values, "club", "")) == tee_of(club):
        moved = None
    else:
        del newest[CalibrationKind.BALL]
    entries, others = (
        tuple(found[kind] for kind in CalibrationKind if kind in found) for found in (newest, later)
    )
    bad = tuple(unreadable[kind] for kind in CalibrationKind if kind in unreadable)
    return Calibration(bench, club, when, entries, required, others, bad, moved)


def calibration_of(configuration: Configuration, when: datetime, club: str | None = None) -> Calibration:
    """Return the calibrations in force at `when` with `club` mounted; creates no database.

    The club is that of `configuration` if no name is given.

    Raises:
        BenchError: the database cannot be read.
    """
    c, mounted = configuration, configuration.swing.club if club is None else club
    required = c.is_machine  # elsewhere nominal values are right
    url = database_url(c.bench.database, c.bench.data_dir)
    if not is_there(url):
        return Calibration(c.bench.id, mounted, when, (), required)
    with open_database(url, when) as database:
        return effective_calibration(
            database, c.bench.id, when, club=mounted, required=required, tee_of=c.tee_of
        )


def _entry(r: Any) -> Entry:
    kind = CalibrationKind(r.kind)
    location = f"calibration {kind} version {r.version} in the database"
    return Entry(
        r.id,
        r.bench,
        kind,
        r.version,
        r.date,
        r.expires,
        r.by,
        r.method,
        r.note,
        values_of(kind, r.content, location),
    )


def add_aerodynamics(
    database: Engine, bench: str, values: BallAerodynamics, *, date: datetime, source: str, by: str
) -> AerodynamicsEntry:
    """Store `values` as the next version of their ball and return the entry.

    Raises:
        BenchError: `source` or `by` is empty.
    """
    location = f"calibrate aerodynamics {values.ball}"
    for name, found in (("--source", source), ("--by", by)):
        if not found.strip():
            raise BenchError(f"{location}: {name}", "missing", "a text", f"Add {name} TEXT to the command.")
    source, by = source.strip(), by.strip()
    row = {
        "bench": bench,
        "ball": values.ball,
        "date": date,
        "source": source,
        "by": by,
        "content": asdict(values),
    }
    with transaction(database, writes=True) as connection:
        version = add_version(connection, BALL_AERODYNAMICS, "ball", row)
    return AerodynamicsEntry(version, date, source, by, values)


def list_aerodynamics(database: Engine, bench: str) -> list[AerodynamicsEntry | UnreadableEntry]:
    """Return all measurements of `bench` in the order in which they were entered."""
    kind = literal("aerodynamics")
    return _stored(database, BALL_AERODYNAMICS, bench, (kind, BALL_AERODYNAMICS.c.ball), _aerodynamics)


def _aerodynamics(row: Any) -> AerodynamicsEntry:
    location = f"aerodynamics of {row.ball}, version {row.version}"
    values = checked_values(BallAerodynamics, row.content, location)
    return AerodynamicsEntry(row.version, row.date, row.source, row.by, values)


def newest_aerodynamics(database: Engine, bench: str, balls: Iterable[str]) -> dict[str, AerodynamicsEntry]:
    """Return the newest measurement of each of `balls` that has one, by ball.

    Raises:
        BenchError: the newest one of a ball is unreadable.
    """
    newest = {entry.subject: entry for entry in list_aerodynamics(database, bench)}
    found = {ball: newest[ball] for ball in balls if ball in newest}
    for entry in found.values():
        if isinstance(entry, UnreadableEntry):
            raise entry.problem
    return {ball: entry for ball, entry in found.items() if isinstance(entry, AerodynamicsEntry)}
