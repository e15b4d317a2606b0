"""Campaigns in the database: batches are whole or not there, hits are counted once."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

import pytest
from sqlalchemy import Connection, create_engine, make_url
from sqlalchemy import event as events
from sqlalchemy.exc import OperationalError

from bench.base.errors import BenchError, Refused
from bench.config import database_url
from bench.records.shot.shot import COLUMNS, Shot, ShotStatus
from bench.store import database
from bench.store.campaigns import CampaignStore, StoredShot
from bench.store.database import SHOTS, DatabaseLocked, open_database
from bench.store.rows import (
    AirReading,
    CampaignEntry,
    CampaignRun,
    CampaignState,
    Event,
    Hit,
    Prompt,
    ShotExclusion,
    ShotNote,
    Standing,
)
from tests.bench.lossy_proxy import LossyProxy
from tests.bench.running_postgres import PostgresServer, running_postgres

NOW = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)
ENTRY = CampaignEntry(
    id="two-20261121T120000",
    bench="bench1",
    name="two",
    title="Two",
    date=NOW,
    simulated=True,
    seed=7,
    plan={"design": {"blocks": 3}},
    digest="0123456789abcdef",
    configuration={"loop": {"rate": 1000.0}},
    versions={"golfbench": "0.1.0"},
    real_time={},
    calibrations={},
    golfers={"anna, driver": {"golfer": "Anna", "deviation": [0.045]}},
)
SHOT = Shot(
    1,
    1,
    1,
    "driver",
    "tour",
    ShotStatus.VALID,
    club_speed_mps=42.1,
    carry_m=181.25,
    delivery_source="simulated",
    time_utc=NOW,
    swing="default",
    sample=3,
    air_temperature_k=298.15,
)
PROMPTS = [
    Prompt(1, 1, "club", "Mount club driver.", {"club": "driver"}, NOW, NOW, "Ann"),
    Prompt(2, 3, "club", "Mount club iron.", {"club": "iron"}, NOW),
]


def _shots(first: int, count: int) -> list[StoredShot]:
    return [StoredShot(replace(SHOT, shot=n), f"swings/{n}", 10 * n) for n in range(first, first + count)]


@contextmanager
def _store(url: Any) -> Iterator[CampaignStore]:
    with open_database(url, NOW) as engine:
        yield CampaignStore(engine)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[CampaignStore]:
    with _store(database_url("", tmp_path)) as store:
        yield store


def _round_trip(url: Any) -> None:
    with _store(url) as store:
        store.begin(ENTRY)
        assert store.entry(ENTRY.id) == ENTRY
        event = Event(NOW, 2, "guard", "guard opened")
        store.add(
            ENTRY, _shots(1, 2), [event], {Hit("ball", "tour", 3): 2, Hit("club", "driver"): 2}, PROMPTS[:1]
        )
        store.ask(ENTRY.id, PROMPTS[1])
        assert store.prompts(ENTRY.id) == PROMPTS
        assert store.answer(ENTRY.id, 2, "Bob", NOW)
        assert not store.answer(ENTRY.id, 2, "Carl", NOW), "answered once"
        answered = PROMPTS[1]._replace(answered=NOW, by="Bob")
        assert store.prompts(ENTRY.id) == [PROMPTS[0], answered]
        assert store.last_answered(ENTRY, "club") == (ENTRY.id, answered)
        assert store.last_answered(ENTRY, "balls") is None
        store.add(ENTRY, _shots(3, 1), hits={Hit("ball", "tour", 3): 1})
        assert store.shots(ENTRY.id) == _shots(1, 3)
        assert store.events(ENTRY.id) == [event]
        assert store.hits(ENTRY.id) == {Hit("ball", "tour", 3): 3, Hit("club", "driver"): 2}
        asked = Standing(CampaignState.PAUSED, "lunch", "pause", "Ann")
        store.change(ENTRY.id, **asked._asdict())
        assert store.standing(ENTRY.id) == asked
        ((entry, standing, counts),) = store.entries()
        assert (entry, standing.reason, counts) == (ENTRY, "lunch", Counter(valid=3))


def test_campaign_store_sqlite_restores_all_entries(tmp_path: Path) -> None:
    _round_trip(database_url("", tmp_path))


@pytest.mark.requires("postgres")
def test_campaign_store_postgresql_restores_all_entries(postgres: str, tmp_path: Path) -> None:
    _round_trip(database_url(postgres, tmp_path))


@pytest.fixture
def server(tool: Callable[[str], str]) -> Iterator[PostgresServer]:
    """A server with an empty database that lives as long as the test."""
    with running_postgres(Path(tool("postgres"))) as server:
        yield server


@pytest.fixture
def postgres(server: PostgresServer) -> str:
    """The URL of its database."""
    return server.url


WRITER = """
import sys
import time
from dataclasses import replace
from pathlib import Path
from sqlalchemy import make_url
from bench.store.campaigns import CampaignStore, StoredShot
from bench.store.rows import Hit
from bench.store.database import open_database
from tests.bench.store.test_campaigns import ENTRY, SHOT

url, name, count, away = sys.argv[1], sys.argv[2], int(sys.argv[3]), Path(sys.argv[4])
entry = replace(ENTRY, id=name, bench=name)
with open_database(make_url(url)) as engine:
    store = CampaignStore(engine)
    store.waiting = lambda locked: print(f"{name} waits: {locked.state}", file=sys.stderr)
    if name not in {found.id for found, _, _ in store.entries()}:
        store.begin(entry)
    for number in range(len(store.shots(name)) + 1, count + 1):
        shots = [StoredShot(replace(SHOT, shot=number), str(number))]
        store.add(entry, shots, hits={Hit("club", "driver"): 1})
        store.change(name, reason=f"shot {number}")
        print(number, flush=True)
        while number == count // 2 and not away.exists():  # the server goes in the middle of the work
            time.sleep(0.01)
"""


@pytest.mark.live
@pytest.mark.requires("postgres")
def test_campaign_store_server_restart_and_killed_bench_lose_no_shot(
    server: PostgresServer, tmp_path: Path
) -> None:
    count, names = 60, [f"bench{k}" for k in range(4)]
    with _store(make_url(server.url)):
        pass
    log, away = tmp_path / "log", tmp_path / "away"

    def start(name: str) -> subprocess.Popen[str]:
        with log.open("a") as errors:
            command = [sys.executable, "-c", WRITER, server.url, name, str(count), str(away)]
            return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)

    writers = {name: start(name) for name in names}
    try:
        for name in names:  # all four are at work
            output = writers[name].stdout
            assert output is not None
            while int(output.readline() or count) < 5:
                pass
        writers["bench0"].kill()
        writers["bench0"].communicate()
        again = writers["bench0"] = start("bench0")
        assert again.stdout is not None
        assert again.stdout.readline(), log.read_text()  # at work again
        server.stop()
        away.touch()
        deadline = time.monotonic() + 60.0
        while "waits: out of reach" not in log.read_text() and time.monotonic() < deadline:
            time.sleep(0.05)
        server.start()
        for writer in writers.values():
            writer.communicate(timeout=100)
            assert writer.returncode == 0, log.read_text()
    finally:
        for writer in writers.values():
            writer.kill()
            writer.wait()
    assert "waits: out of reach" in log.read_text(), log.read_text()
    with _store(make_url(server.url)) as store:
        assert sorted(entry.id for entry, _, _ in store.entries()) == names
        for name in names:
            assert [stored.shot.shot for stored in store.shots(name)] == list(range(1, count + 1))
            assert store.hits(name) == {Hit("club", "driver"): count}
            assert store.standing(name).reason == f"shot {count}"


@pytest.mark.live
@pytest.mark.requires("postgres")
def test_campaign_store_locked_server_write_times_out_then_succeeds(
    postgres: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "BUSY_TIMEOUT", 0.05)
    with _store(make_url(postgres)) as store, _store(make_url(postgres)) as other:
        store.begin(ENTRY)
        with database.transaction(other.database, writes=True):
            with pytest.raises(DatabaseLocked, match="locked by another process"):
                store.change(ENTRY.id, reason="lunch")
            assert store.standing(ENTRY.id).reason == "", "readers do not wait"
        store.change(ENTRY.id, reason="lunch")
        assert store.standing(ENTRY.id).reason == "lunch"


Loss = Literal["before", "after"]


def _write_all(store: CampaignStore, cut: Callable[[], None]) -> None:
    """Write in every way that there is, each after `cut`; require that all is there once.

    Two commits are cut, as the first of a note's is that of a look.
    """

    def wrote(write: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        cut()
        return write(*arguments, **options)

    event, hit = Event(NOW, 2, "guard", "guard opened"), Hit("club", "driver")
    note, exclusion = ShotNote(2, NOW, "Ann", "a gust"), ShotExclusion(2, NOW, "Ann", "a gust", True, 2)
    wrote(store.begin, ENTRY)
    wrote(store.begin_run, ENTRY.id, CampaignRun(0, NOW, "Ann"))
    wrote(store.note_event, ENTRY.id, event)
    wrote(store.add, ENTRY, _shots(1, 2), [event], {hit: 2}, PROMPTS[:1])
    wrote(store.add, ENTRY, [], [event], {hit: 1})
    wrote(store.add_note, ENTRY.id, note)
    wrote(store.add_exclusion, ENTRY.id, exclusion)
    wrote(store.ask, ENTRY.id, PROMPTS[1])
    assert wrote(store.answer, ENTRY.id, 2, "Bob", NOW)
    assert not wrote(store.answer, ENTRY.id, 2, "Carl", NOW)
    wrote(store.set_aside, ENTRY.id, [2], event)
    wrote(store.change, ENTRY.id, reason="lunch")
    assert [run.number for run in store.runs(ENTRY.id)] == [1]
    assert store.events(ENTRY.id) == [event] * 4
    assert [stored.set_aside for stored in store.shots(ENTRY.id)] == [False, True]
    assert store.hits(ENTRY.id) == {hit: 3}
    assert (store.notes(ENTRY.id), store.exclusions(ENTRY.id)) == ([note], [exclusion])
    assert store.prompts(ENTRY.id) == [PROMPTS[0], PROMPTS[1]._replace(answered=NOW, by="Bob")]
    assert store.standing(ENTRY.id).reason == "lunch"


class LostAnswer(Exception):
    """Exception of a server's driver without a connection."""

    sqlstate = None


@pytest.mark.parametrize("loss", ["before", "after"])
def test_campaign_store_lost_commit_is_stored_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, loss: Loss
) -> None:
    commit, losses = Connection.commit, list[Loss]()

    def lossy(self: Connection) -> None:
        cut = losses.pop() if losses else ""
        if cut != "before":
            commit(self)
        if cut:
            raise OperationalError("COMMIT", {}, LostAnswer())

    with _store(database_url("", tmp_path)) as store:
        store.waiting = lambda _: None
        monkeypatch.setattr(Connection, "commit", lossy)
        _write_all(store, lambda: losses.extend([loss, loss]))
        assert losses == []
        store.waiting = None
        losses.append(loss)
        with pytest.raises(OperationalError):  # who does not wait does not repeat
            store.change(ENTRY.id, reason="tea")


@pytest.mark.live
@pytest.mark.requires("postgres")
@pytest.mark.parametrize("loss", ["before", "after"])
def test_campaign_store_server_connection_loss_stores_commit_once(
    server: PostgresServer, tmp_path: Path, loss: Loss
) -> None:
    with LossyProxy(tmp_path, server.folder) as proxy, _store(make_url(proxy.url)) as store:
        store.waiting = lambda _: None
        _write_all(store, lambda: setattr(proxy, loss, 2))
        assert (proxy.before, proxy.after) == (0, 0)


def test_campaign_store_manual_exclusion_changes_shot_counts(store: CampaignStore) -> None:
    store.begin(ENTRY)
    failed = StoredShot(replace(SHOT, shot=4, status=ShotStatus.FAILED, reason="no ball"))
    store.add(ENTRY, [*_shots(1, 3), failed])
    for shot, excluded in ((1, True), (2, True), (2, False), (2, True), (3, True), (3, False), (4, True)):
        store.add_exclusion(ENTRY.id, ShotExclusion(shot, NOW, "Ann", "a gust", excluded, 4))
    ((_, _, counts),) = store.entries()
    assert {status: counts[status] for status in ShotStatus} == {"valid": 1, "excluded": 2, "failed": 1}


def test_campaign_store_conflicting_batch_is_rolled_back(store: CampaignStore) -> None:
    store.begin(ENTRY)
    store.add(ENTRY, _shots(1, 3), hits={Hit("club", "driver"): 3})
    with pytest.raises(Refused, match="one runner"):
        store.add(ENTRY, [*_shots(4, 2), *_shots(3, 1)], hits={Hit("club", "driver"): 3})
    assert len(store.shots(ENTRY.id)) == 3
    assert store.hits(ENTRY.id)[Hit("club", "driver")] == 3


def test_campaign_store_second_issue_of_one_number_is_refused(store: CampaignStore) -> None:
    store.begin(ENTRY)
    issue = Event(NOW, 1, "issue", "issued by Ann")
    store.note_issue(ENTRY.id, issue, 1)
    with pytest.raises(Refused, match="issued meanwhile"):
        store.note_issue(ENTRY.id, issue, 1)
    store.note_issue(ENTRY.id, issue, 2)
    assert store.events(ENTRY.id) == [issue, issue]


def test_campaign_store_duplicate_or_unknown_id_is_refused(store: CampaignStore) -> None:
    store.begin(ENTRY)
    with pytest.raises(Refused, match="the id exists already"):
        store.begin(ENTRY)
    with pytest.raises(BenchError, match="no such campaign"):
        store.entry("other")


def test_campaign_store_real_bench_hits_sum_over_campaigns(store: CampaignStore) -> None:
    real = replace(ENTRY, simulated=False)
    for number in (1, 2):
        entry = replace(real, id=f"c{number}")
        store.begin(entry)
        store.add(entry, _shots(1, 1), hits={Hit("ball", "tour", 3): 5})
    assert store.hits("bench1") == {Hit("ball", "tour", 3): 10}


def test_campaign_store_entries_order_ignores_clock_set_back(store: CampaignStore) -> None:
    for name, hours in (("a", 0), ("b", -30), ("c", -20)):
        store.begin(replace(ENTRY, id=name, date=NOW + timedelta(hours=hours)))
    assert [entry.id for entry, _, _ in store.entries()] == ["c", "b", "a"]


def test_last_answered_clock_set_back_returns_latest_club(store: CampaignStore) -> None:
    """An old campaign that is resumed may mount a club after a newer one did."""
    first, second = (replace(ENTRY, id=name, simulated=False) for name in ("old", "new"))
    for entry in (first, second):
        store.begin(entry)
        store.ask(entry.id, PROMPTS[1]._replace(number=1))
    assert store.last_answered(first, "club") is None
    answered = []
    for campaign, hours in (("new", 0), ("old", -2)):
        store.answer(campaign, 1, "Ann", NOW + timedelta(hours=hours))
        answered.append(store.last_answered(first, "club"))
    assert [found and found[0] for found in answered] == ["new", "old"]
    store.add(second, [], prompts=[PROMPTS[0]._replace(number=2, answered=NOW - timedelta(hours=9))])
    assert store.last_answered(first, "club") == (
        "new",
        PROMPTS[0]._replace(number=2, answered=NOW - timedelta(hours=9)),
    )


def test_campaign_store_restores_runs_notes_and_set_aside_shots(store: CampaignStore) -> None:
    store.begin(ENTRY)
    store.begin_run(ENTRY.id, CampaignRun(0, NOW, "Ann", {"numpy": "2"}, {"driver": "sim"}))
    store.begin_run(ENTRY.id, CampaignRun(0, NOW, "Bob", {"numpy": "3"}))
    assert [(run.number, run.by, run.versions) for run in store.runs(ENTRY.id)] == [
        (1, "Ann", {"numpy": "2"}),
        (2, "Bob", {"numpy": "3"}),
    ]
    store.add(ENTRY, _shots(1, 3))
    lost = replace(SHOT, shot=4, status=ShotStatus.FAILED, reason="no ball")
    store.add(ENTRY, [StoredShot(lost)])
    event = Event(NOW, 5, "restart", "block 1 restarted")
    store.set_aside(ENTRY.id, [3, 4], event)
    assert [stored.set_aside for stored in store.shots(ENTRY.id)] == [False, False, True, True]
    fates = [(stored.shot.status, stored.shot.reason) for stored in store.shots(ENTRY.id)[2:]]
    assert fates == [(ShotStatus.EXCLUDED, "block 1 restarted"), (ShotStatus.FAILED, "no ball")]
    assert store.events(ENTRY.id) == [event]
    store.add_note(ENTRY.id, ShotNote(2, NOW, "Ann", "a gust"))
    store.add_note(ENTRY.id, ShotNote(1, NOW, "Ann", ""))
    assert [(note.shot, note.text) for note in store.notes(ENTRY.id)] == [(1, ""), (2, "a gust")]
    with pytest.raises(Refused, match="no shot 5, expected a shot from 1 to 4"):
        store.add_note(ENTRY.id, ShotNote(5, NOW, "Ann", ""))


@contextmanager
def _locked(folder: Path, kind: str) -> Iterator[sqlite3.Connection]:
    """Hold the database as another program does: its write lock, or all of it."""
    with closing(sqlite3.connect(folder / "golfbench.sqlite", isolation_level=None)) as other:
        if kind == "exclusive":
            other.execute("PRAGMA locking_mode=EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        yield other


@pytest.mark.live
@pytest.mark.parametrize("kind", ["immediate", "exclusive"])
def test_campaign_store_locked_database_waits_while_callback_allows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(database, "BUSY_TIMEOUT", 0.05)
    with _store(database_url("", tmp_path)) as store:
        store.begin(ENTRY)
    with _locked(tmp_path, kind) as other, open_later(database_url("", tmp_path)) as store:
        with pytest.raises(DatabaseLocked, match="locked by another process"):
            store.change(ENTRY.id, reason="lunch")
        waited = list[float]()

        def waiting(fault: DatabaseLocked) -> None:
            waited.append(fault.waited)
            if len(waited) == 3:
                other.execute("ROLLBACK")
                other.close()

        store.waiting = waiting
        store.change(ENTRY.id, reason="lunch")
        assert store.standing(ENTRY.id).reason == "lunch"
        assert len(waited) == 3
        assert waited == sorted(waited)


@contextmanager
def open_later(url: Any) -> Iterator[CampaignStore]:
    """Open a database that is locked already, past the check of its version."""
    engine = create_engine(url, connect_args={"timeout": 0.05})
    events.listen(engine, "connect", lambda connection, _: setattr(connection, "isolation_level", None))
    events.listen(engine, "begin", database._begin_sqlite)
    try:
        yield CampaignStore(engine)
    finally:
        engine.dispose()


def test_shots_table_has_every_export_column() -> None:
    columns = set(SHOTS.columns.keys())
    assert columns == {*COLUMNS} | {"campaign", "file", "bytes", "set_aside"}


HOUR = timedelta(hours=1)
COLD = AirReading("bench1", NOW, 285.0, 1.0e5, 0.4, "Ann")


def test_newest_air_returns_last_added_until_expiry(store: CampaignStore) -> None:
    warm = AirReading("bench1", NOW + HOUR, 295.0, 1.01e5, 0.5, "station 3")
    assert store.newest_air("bench1", NOW) is None
    store.add_air(COLD)
    store.add_air(warm)
    assert store.newest_air("bench1", NOW) == warm
    assert store.newest_air("bench1", NOW + HOUR) == warm
    assert store.newest_air("bench1", NOW + 2 * HOUR) is None
    assert store.newest_air("bench2", NOW) is None


def test_newest_air_clock_set_back_returns_last_added(store: CampaignStore) -> None:
    after = COLD._replace(date=NOW - HOUR)
    store.add_air(COLD)
    store.add_air(after)
    assert store.newest_air("bench1", NOW - 2 * HOUR) == after
    assert store.newest_air("bench1", NOW) == COLD
