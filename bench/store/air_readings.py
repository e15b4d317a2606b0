"""Readings of the air at the bench; the newest is used for a limited time."""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

from sqlalchemy import Engine, insert, select

from bench.store.database import AirReadingRow, Row
from sim.aerodynamics import Air

_READINGS = Row.metadata.tables[AirReadingRow.__tablename__]


class AirReading(NamedTuple):
    """One reading of the air."""

    date: datetime
    air: Air
    by: str
    """Who or what read it."""


def add_reading(database: Engine, bench: str, reading: AirReading) -> None:
    """Add a reading at `bench`."""
    air = reading.air
    row = {
        "bench": bench,
        "date": reading.date,
        "temperature": air.temperature,
        "pressure": air.pressure,
        "relative_humidity": air.relative_humidity,
        "by": reading.by,
    }
    with database.execution_options(sqlite_begin="IMMEDIATE").begin() as connection:
        connection.execute(insert(_READINGS).values(row))


def newest_reading(database: Engine, bench: str, since: datetime) -> AirReading | None:
    """Return the reading added last at `bench`, of those dated `since` or later; None if there is none.

    The last one added is the newest whatever the clock said, which may have been set back.
    """
    c = _READINGS.c
    query = (
        select(c.date, c.temperature, c.pressure, c.relative_humidity, c.by)
        .where((c.bench == bench) & (c.date >= since))
        .order_by(c.id.desc())
        .limit(1)
    )
    with database.connect() as connection:
        row = connection.execute(query).first()
    return None if row is None else AirReading(row[0], Air(*row[1:4]), row[4])
