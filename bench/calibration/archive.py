"""Calibrations and aerodynamics of balls in the bench's database: added, listed, never changed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import Engine, func, select

from bench.base.errors import BenchError
from bench.base.from_toml import checked_values
from bench.calibration.ball_aerodynamics import AerodynamicsEntry, BallAerodynamics
from bench.calibration.calibration import (
    VALID_DAYS,
    Calibration,
    CalibrationKind,
    Entry,
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
        BenchError: it expires before it begins, a newer one exists, or `by` or `method` is empty.
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
        "subject": getattr(values, "club", ""),
        "date": date,
        "expires": expires,
        "by": by.strip(),
        "method": method.strip(),
        "note": note.strip(),
        "content": content_of(values),
    }
    c = CALIBRATIONS.c
    with transaction(database, writes=True) as connection:
        before = connection.scalar(select(func.max(c.date)).where(c.bench == bench, c.kind == kind.value))
        if before is not None and before > date:
            expected = f"after the one before, of {before:%Y-%m-%d %H:%M:%S} UTC"
            action = "Set this machine's clock: a calibration is only superseded by a later one."
            raise BenchError(f"calibrate {kind}: date", f"{date:%Y-%m-%d %H:%M:%S} UTC", expected, action)
        version = add_version(connection, CALIBRATIONS, "kind", row)
    return next(entry for entry in list_calibrations(database, bench, kind) if entry.version == version)


def list_calibrations(database: Engine, bench: str, kind: CalibrationKind | None = None) -> list[Entry]:
    """Return all calibrations of `bench`, of one kind or of every one, oldest first.

    Raises:
        ExceptionGroup: one BenchError per mistake in a row that golfbench did not write.
    """
    c = CALIBRATIONS.c
    wanted = select(CALIBRATIONS).where(c.bench == bench)
    if kind is not None:
        wanted = wanted.where(c.kind == kind.value)
    with database.connect() as connection:
        rows = connection.execute(wanted.order_by(c.date, c.id)).all()
    return [_entry(row) for row in rows]


def effective_calibration(
    database: Engine, bench: str, when: datetime, *, club: str = "", required: bool = False
) -> Calibration:
    """Return the calibrations in force on `bench` at `when` with `club` mounted: the newest of each kind.

    `required` says that a kind without a calibration is a problem (a machine), not nominal (simulation).
    """
    newest: dict[CalibrationKind, Entry] = {}
    later: dict[CalibrationKind, Entry] = {}
    for entry in list_calibrations(database, bench):
        if entry.subject in {"", club}:
            (newest if entry.date <= when else later)[entry.kind] = entry
    entries, others = (
        tuple(found[kind] for kind in CalibrationKind if kind in found) for found in (newest, later)
    )
    return Calibration(bench, club, when, entries, required, others)


def calibration_of(configuration: Configuration, when: datetime) -> Calibration:
    """Return the calibrations in force for `configuration` at `when`; creates no database.

    Raises:
        BenchError: the database cannot be read.
    """
    c = configuration
    required = c.is_machine  # elsewhere nominal values are right
    url = database_url(c.bench.database, c.bench.data_dir)
    if not is_there(url):
        return Calibration(c.bench.id, c.swing.club, when, (), required)
    with open_database(url, when) as database:
        return effective_calibration(database, c.bench.id, when, club=c.swing.club, required=required)


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
            raise BenchError(f"{location}: {name}", "missing", "a text", f"State the text with {name}.")
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


def list_aerodynamics(database: Engine, bench: str) -> list[AerodynamicsEntry]:
    """Return all measurements of `bench`, by ball, oldest first.

    Raises:
        ExceptionGroup: one BenchError per mistake in a row that golfbench did not write.
    """
    c = BALL_AERODYNAMICS.c
    query = select(c.version, c.date, c.source, c.by, c.content, c.ball).where(c.bench == bench)
    with database.connect() as connection:
        rows = connection.execute(query.order_by(c.ball, c.version)).all()
    found = []
    for row in rows:
        location = f"aerodynamics of {row.ball}, version {row.version}"
        values = checked_values(BallAerodynamics, row.content, location)
        found.append(AerodynamicsEntry(row.version, row.date, row.source, row.by, values))
    return found


def newest_aerodynamics(database: Engine, bench: str, balls: Iterable[str]) -> dict[str, AerodynamicsEntry]:
    """Return the newest measurement of each of `balls` that has one, by ball.

    Raises as `list_aerodynamics`.
    """
    wanted = set(balls)
    found = list_aerodynamics(database, bench)
    return {entry.values.ball: entry for entry in found if entry.values.ball in wanted}
