"""Measured aerodynamics of balls in the bench's database: added, listed, never changed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from datetime import datetime

from sqlalchemy import Engine, func, insert, select
from sqlalchemy.exc import IntegrityError

from bench.calibration.ball_aerodynamics import AerodynamicsEntry, BallAerodynamics, aerodynamics_values
from bench.errors import BenchError
from bench.store.tables import BallAerodynamicsRow, Row

_TABLE = Row.metadata.tables[BallAerodynamicsRow.__tablename__]


def add_aerodynamics(
    database: Engine, bench: str, values: BallAerodynamics, *, date: datetime, source: str, by: str
) -> AerodynamicsEntry:
    """Store `values` as the next version of their ball and return the entry.

    Raises:
        BenchError: `source` or `by` is empty, or another process added one at the same instant.
    """
    place = f"calibrate aerodynamics {values.ball}"
    for name, found in (("--source", source), ("--by", by)):
        if not found.strip():
            raise BenchError(f"{place}: {name}", "missing", "a text", f"State the text with {name}.")
    source, by, c = source.strip(), by.strip(), _TABLE.c
    newest = select(func.max(c.version)).where((c.bench == bench) & (c.ball == values.ball))
    row = {
        "bench": bench,
        "ball": values.ball,
        "version": func.coalesce(newest.scalar_subquery(), 0) + 1,
        "date": date,
        "source": source,
        "by": by,
        "content": asdict(values),
    }
    try:
        with database.execution_options(sqlite_begin="IMMEDIATE").begin() as connection:
            version = connection.execute(insert(_TABLE).values(row).returning(c.version)).scalar_one()
    except IntegrityError as error:  # SQLite writes in turn, a server may not
        raise BenchError(
            place, "a calibration with this version exists", "a later version", "Run the same command again."
        ) from error
    return AerodynamicsEntry(version, date, source, by, values)


def list_aerodynamics(database: Engine, bench: str) -> list[AerodynamicsEntry]:
    """Return all measurements of `bench`, by ball, oldest first.

    Raises:
        ExceptionGroup: of BenchErrors: a stored row was not written by golfbench.
    """
    c = _TABLE.c
    query = select(c.version, c.date, c.source, c.by, c.content, c.ball).where(c.bench == bench)
    with database.connect() as connection:
        rows = connection.execute(query.order_by(c.ball, c.version)).all()
    return [
        AerodynamicsEntry(
            row.version,
            row.date,
            row.source,
            row.by,
            aerodynamics_values(row.content, f"aerodynamics of {row.ball}, version {row.version}"),
        )
        for row in rows
    ]


def newest_aerodynamics(database: Engine, bench: str, balls: Iterable[str]) -> dict[str, AerodynamicsEntry]:
    """Return the newest measurement of each of `balls` that has one, by ball.

    Raises as `list_aerodynamics`.
    """
    wanted = set(balls)
    found = list_aerodynamics(database, bench)
    return {entry.values.ball: entry for entry in found if entry.values.ball in wanted}
