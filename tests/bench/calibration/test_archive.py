"""Calibrations are added with rising versions, never changed, and the newest one counts."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Engine

from bench.base.errors import BenchError
from bench.base.lifecycle import Block
from bench.calibration.archive import (
    add_calibration,
    calibration_of,
    effective_calibration,
    list_calibrations,
)
from bench.calibration.calibration import (
    BallPosition,
    CalibrationKind,
    ClubInMount,
    EncoderZeros,
    Entry,
    UnreadableEntry,
    Values,
    ValveCentres,
    content_of,
    values_of,
)
from bench.config import Configuration, database_url, load_configuration
from bench.store.database import open_database

DAY = timedelta(days=1)
NOW = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)

ZEROS = EncoderZeros((1000.0, 2000.5, 30.25), (1, -1, 1), 131072, 3e-4)
BALL = BallPosition(0.251, -1.559, 5e-4)
CLUB = ClubInMount("driver", 1.091, 0.18, 0.92, 5e-4, 2e-3)
VALVES = ValveCentres((0.01, -0.02, 0.0), (0.02, 0.021, 0.019), 1e-3)
ALL: tuple[Values, ...] = (ZEROS, BALL, CLUB, VALVES)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Engine]:
    with open_database(database_url("", tmp_path), NOW) as engine:
        yield engine


def add(database: Engine, values: Values, date: datetime = NOW, days: float = 10, **more: Any) -> Any:
    texts = {"bench": "b", "by": "me", "method": "rule"} | more
    return add_calibration(database, values=values, date=date, expires=date + days * DAY, **texts)


@pytest.mark.parametrize("values", ALL)
def test_add_calibration_returns_values_unchanged(database: Engine, values: Values) -> None:
    entry = add(database, values, note="new tee")
    assert entry.values == values
    assert (entry.version, entry.bench, entry.by, entry.method, entry.note) == (
        1,
        "b",
        "me",
        "rule",
        "new tee",
    )
    assert (entry.date, entry.expires) == (NOW, NOW + 10 * DAY)
    assert list_calibrations(database, "b") == [entry]
    assert values_of(entry.kind, content_of(values), "here") == values


def test_add_calibration_version_rises_per_kind_and_bench(database: Engine) -> None:
    order: list[tuple[Values, str]] = [(BALL, "b"), (BALL, "b"), (ZEROS, "b"), (BALL, "c"), (BALL, "b")]
    versions = [
        add(database, values, NOW + i * DAY, bench=bench).version for i, (values, bench) in enumerate(order)
    ]
    assert versions == [1, 2, 1, 1, 3]


def test_add_calibration_concurrent_writers_get_unique_versions(database: Engine) -> None:
    with ThreadPoolExecutor(4) as pool:
        entries = list(pool.map(lambda _: add(database, BALL), range(12)))
    assert sorted(entry.version for entry in entries) == list(range(1, 13))


def test_effective_calibration_uses_newest_at_date(database: Engine) -> None:
    for day in range(3):
        add(database, BallPosition(0.25 + 0.001 * day, -1.56, 1e-3), NOW + day * DAY)
    for when, version in ((NOW - DAY, None), (NOW, 1), (NOW + 1.5 * DAY, 2), (NOW + 9 * DAY, 3)):
        entry = effective_calibration(database, "b", when).of(CalibrationKind.BALL)
        assert (entry and entry.version) == version
    assert effective_calibration(database, "c", NOW + 9 * DAY).entries == ()


def test_effective_calibration_date_after_clock_reports_problem(database: Engine) -> None:
    add(database, BALL)
    add(database, BallPosition(0.26, -1.56, 1e-3), NOW + DAY)
    set_back = effective_calibration(database, "b", NOW + 0.5 * DAY)
    (problem,) = set_back.problems(NOW + 0.5 * DAY)
    assert (
        "calibration ball version 2 is of 2026-11-22 12:00 UTC, later than this machine's clock"
        in problem.text
    )
    assert effective_calibration(database, "b", NOW + DAY).problems(NOW + DAY) == []


def test_effective_calibration_uses_only_mounted_club(database: Engine) -> None:
    add(database, CLUB)
    add(database, ClubInMount("iron7", 0.872, 0.57, 1.09, 5e-4, 2e-3), NOW + DAY)
    for club, version in (("driver", 1), ("iron7", 2), ("thesis", None)):
        entry = effective_calibration(database, "b", NOW + 2 * DAY, club=club).of(CalibrationKind.CLUB)
        assert (entry and entry.version) == version


@pytest.mark.parametrize(
    ("measured", "mounted", "in_force"),
    [
        ("driver", "driver", True),
        ("driver", "thesis", True),  # both stand on plant.site
        ("wedge56", "wedge56_wet", True),
        ("wedge56", "pitching", False),  # 6 mm higher
        ("driver", "iron7", False),
        ("iron7", "driver", False),
        ("", "iron7", True),
    ],
)
def test_calibration_of_tee_elsewhere_is_not_in_force(
    tmp_path: Path, measured: str, mounted: str, in_force: bool
) -> None:
    c = load_configuration(Path("bag"))
    c = replace(c, bench=replace(c.bench, data_dir=tmp_path)).with_club(mounted)
    with open_database(database_url("", tmp_path), NOW) as database:
        entry = add(database, replace(BALL, club=measured), bench=c.bench.id)
    machine = c.with_driver(replace(c.driver, name="daq"))
    found = calibration_of(machine, NOW)
    assert (found.of(CalibrationKind.BALL), found.moved) == ((entry, None) if in_force else (None, entry))
    texts = [problem.text for problem in found.problems(NOW) if "ball" in problem.text]
    wrong = "ball of bench bench1 calibrated for the tee of another club (calibration ball version 1)"
    action = f'set the tee for club {mounted}, then golfbench calibrate ball with swing.club = "{mounted}"'
    assert texts == ([] if in_force else [f"{wrong}: {action}"])


def test_add_calibration_supersedes_date_ahead_of_clock(database: Engine) -> None:
    add(database, BALL, NOW + 3650 * DAY)
    (problem,) = effective_calibration(database, "b", NOW).problems(NOW)
    assert problem.action.endswith("golfbench calibrate ball")
    entry = add(database, BALL, NOW)
    found = effective_calibration(database, "b", NOW)
    assert (found.entries, found.problems(NOW)) == ((entry,), [])
    assert effective_calibration(database, "b", NOW + 3660 * DAY).of(CalibrationKind.BALL) == entry


DAMAGED = [
    {"content": {"x": 9.0, "y": -1.56, "uncertainty": 1e-3}},
    {"content": [1, 2]},
    {"content": None},
    {"date": "yesterday"},
    {"content": "no JSON"},
]


@pytest.mark.parametrize("damage", DAMAGED, ids=str)
def test_effective_calibration_unreadable_newest_row_blocks_same_kind_only(
    database: Engine, damage: dict[str, Any]
) -> None:
    add(database, BALL)
    entry = add(database, ZEROS)
    add_damaged(database, damage)
    found = effective_calibration(database, "b", NOW)
    assert found.entries == (entry,)
    assert CalibrationKind.BALL in found.nominal
    (problem,) = found.problems(NOW)
    assert (problem.code, problem.location) == (Block.UNREADABLE, "calibration ball version 2")
    assert problem.action == "golfbench calibrate ball"
    assert [type(one) for one in list_calibrations(database, "b")] == [Entry, Entry, UnreadableEntry]
    newer = add(database, BALL)
    assert (newer.version, effective_calibration(database, "b", NOW).problems(NOW)) == (3, [])


def add_damaged(database: Engine, damage: dict[str, Any]) -> None:
    """Add version 2 of the ball with `damage` by another program."""
    values = {"content": content_of(BALL), "date": str(NOW.replace(tzinfo=None))} | damage
    if values["content"] != "no JSON":
        values["content"] = json.dumps(values["content"])
    row = {"expires": str((NOW + DAY).replace(tzinfo=None)), "by": "x", "method": "x", "note": ""} | values
    with database.begin() as connection:
        connection.exec_driver_sql(
            "INSERT INTO calibrations "
            "(bench, kind, version, subject, date, expires, by, method, note, content) "
            "VALUES ('b', 'ball', 2, '', :date, :expires, :by, :method, :note, :content)",
            row,
        )


@pytest.mark.parametrize(
    ("more", "location"), [({"by": " "}, "--by"), ({"method": ""}, "--method"), ({"days": 0}, "expires")]
)
def test_add_calibration_missing_author_method_or_expiry_is_refused(
    database: Engine, more: dict[str, Any], location: str
) -> None:
    with pytest.raises(BenchError) as refusal:
        add(database, BALL, **more)
    assert location in refusal.value.location
    assert list_calibrations(database, "b") == []


def test_effective_calibration_reports_expired_and_missing_kinds(database: Engine) -> None:
    add(database, BALL, days=1)
    simulated = effective_calibration(database, "b", NOW)
    assert simulated.problems(NOW) == []
    assert simulated.nominal == (
        CalibrationKind.ENCODERS,
        CalibrationKind.CLUB,
        CalibrationKind.VALVES,
        CalibrationKind.INPUTS,
    )
    (problem,) = simulated.problems(NOW + DAY)
    assert "calibration ball version 1 expired on 2026-11-22" in problem.text
    assert "golfbench calibrate ball" in problem.action
    machine = effective_calibration(database, "b", NOW, club="iron7", required=True).problems(NOW)
    assert [problem.text.split(":")[0] for problem in machine] == [
        "encoders of bench b never calibrated",
        "club iron7 of bench b never calibrated",
        "valves of bench b never calibrated",
        "inputs of bench b never calibrated",
    ]


def test_calibration_of_creates_no_database(tmp_path: Path) -> None:
    configuration = _at(tmp_path, "sim")
    calibration = calibration_of(configuration, NOW)
    assert calibration.nominal == tuple(CalibrationKind)
    assert calibration.problems(NOW) == []
    assert not (tmp_path / "data").exists()


def test_calibration_of_local_socket_requires_no_calibration(tmp_path: Path) -> None:
    machine = _at(tmp_path, "canopen")
    played = replace(machine, canopen=replace(machine.canopen, interface="local_socket"))
    assert not calibration_of(played, NOW).required


@pytest.mark.parametrize(("driver", "required"), [("sim", False), ("mock", False), ("canopen", True)])
def test_calibration_of_requires_calibration_only_with_canopen(
    tmp_path: Path, driver: str, required: bool
) -> None:
    configuration = _at(tmp_path, driver)
    assert calibration_of(configuration, NOW).required is required
    bench = configuration.bench
    with open_database(database_url(bench.database, bench.data_dir), NOW) as database:
        add(database, BALL, bench=bench.id)
    calibration = calibration_of(configuration, NOW)
    assert calibration.required is required
    assert [entry.values for entry in calibration.entries] == [BALL]


def _at(folder: Path, driver: str) -> Configuration:
    from dataclasses import replace

    c = load_configuration(Path("shipped"))
    bench = replace(c.bench, data_dir=folder / "data")
    return replace(c, bench=bench, driver=replace(c.driver, name=driver))


@pytest.mark.parametrize(
    ("kind", "content", "places"),
    [
        (CalibrationKind.BALL, {"x": 0.2, "y": -1.5}, ["here: uncertainty"]),
        (
            CalibrationKind.BALL,
            {"x": float("nan"), "y": 9.0, "uncertainty": True},
            ["here: x", "here: y", "here: unc"],
        ),
        (CalibrationKind.BALL, {"x": 0.2, "y": -1.5, "uncertainty": 0.001, "z": 1.0}, ["here: z"]),
        (
            CalibrationKind.VALVES,
            {"centre": [0.0, 0.3, 0.0], "dead_band": [0.0], "uncertainty": 0.0},
            ["here: centre[1]", "here: dead_band"],
        ),
        (CalibrationKind.ENCODERS, content_of(ZEROS) | {"sign": [1, 0, 1]}, ["here"]),
        (
            CalibrationKind.ENCODERS,
            content_of(ZEROS) | {"counts_per_revolution": 3},
            ["here: counts_per_revolution"],
        ),
    ],
)
def test_values_of_names_every_wrong_value(
    kind: CalibrationKind, content: dict[str, Any], places: list[str]
) -> None:
    with pytest.raises(ExceptionGroup) as group:
        values_of(kind, content, "here")
    found = [error.location for error in group.value.exceptions if isinstance(error, BenchError)]
    assert len(found) == len(places)
    for location, start in zip(found, places, strict=True):
        assert location.startswith(start)
