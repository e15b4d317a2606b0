"""Readings of the air: the newest of a bench counts, for a time."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

from bench.config import database_url
from bench.store.air_readings import AirReading, add_reading, newest_reading
from bench.store.database import open_database
from sim.aerodynamics import Air

NOON = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)
HOUR = timedelta(hours=1)


def test_newest_reading_returns_last_added_until_expiry(tmp_path: Path) -> None:
    cold, warm = AirReading(NOON, Air(285.0, 1.0e5, 0.4), "Ann"), AirReading(NOON + HOUR, Air(), "station 3")
    with open_database(database_url("", tmp_path)) as database:
        assert newest_reading(database, "bench1", NOON) is None
        add_reading(database, "bench1", cold)
        add_reading(database, "bench1", warm)
        assert newest_reading(database, "bench1", NOON) == warm
        assert newest_reading(database, "bench1", NOON + HOUR) == warm
        assert newest_reading(database, "bench1", NOON + 2 * HOUR) is None
        assert newest_reading(database, "bench2", NOON) is None


def test_newest_reading_clock_set_back_returns_last_added(tmp_path: Path) -> None:
    before, after = AirReading(NOON, Air(285.0, 1.0e5, 0.4), "Ann"), AirReading(NOON - HOUR, Air(), "Ann")
    with open_database(database_url("", tmp_path)) as database:
        add_reading(database, "bench1", before)
        add_reading(database, "bench1", after)
        assert newest_reading(database, "bench1", NOON - 2 * HOUR) == after
        assert newest_reading(database, "bench1", NOON) == before
