"""Calibrations in force and the newest reading of the air, for the page."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from bench.calibration.archive import calibration_of
from bench.calibration.value_words import in_words
from bench.calibration.values import CalibrationKind
from bench.config import Configuration, database_url
from bench.page.entry_forms import described_forms
from bench.store.air_readings import newest_reading
from bench.store.database import is_there, open_database


def bench_values(configuration: Configuration) -> dict[str, Any]:
    """Return calibrations in force, problems, the air, and the forms to enter newer ones.

    Raises:
        BenchError: the database cannot be read.
    """
    now = datetime.now(UTC)
    calibration = calibration_of(configuration, now)
    entries = []
    for kind in CalibrationKind:
        entry = calibration.of(kind)
        nominal = "not checked" if kind is CalibrationKind.INPUTS else "nominal, as the configuration has it"
        missing = "missing" if calibration.required else nominal
        entries.append(
            {
                "kind": kind.value,
                "words": missing if entry is None else in_words(entry.values),
                "version": None if entry is None else entry.version,
                "by": "" if entry is None else entry.by,
                "date": None if entry is None else entry.date.isoformat(timespec="seconds"),
                "expires": None if entry is None else entry.expires.isoformat(timespec="seconds"),
                "expired": entry is not None and entry.expired(now),
            }
        )
    return {
        "club": calibration.club,
        "entries": entries,
        "problems": [problem.text for problem in calibration.problems(now)],
        "air": _air(configuration, now),
        "forms": described_forms(list(configuration.clubs)),
    }


def _air(configuration: Configuration, now: datetime) -> dict[str, Any] | None:
    """Return the newest reading of the air; None without one."""
    bench = configuration.bench
    url = database_url(bench.database, bench.data_dir)
    if not is_there(url):
        return None
    with open_database(url, now) as engine:
        found = newest_reading(engine, bench.id, datetime(1970, 1, 1, tzinfo=UTC))
    if found is None:
        return None
    return {
        "temperature_c": found.air.temperature - 273.15,
        "pressure_hpa": found.air.pressure / 100.0,
        "humidity_percent": 100.0 * found.air.relative_humidity,
        "date": found.date.isoformat(timespec="seconds"),
        "by": found.by,
    }
