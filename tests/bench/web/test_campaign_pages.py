"""Campaigns, reports and records on the page: shown from the database, changed as at the command line."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from bench.base.lifecycle import State
from bench.campaign.run.campaign_control import runner_lock
from bench.config import Configuration, database_url
from bench.records.shot.recorded_shot import plant_of
from bench.records.telemetry.record_file import read_swing
from bench.records.telemetry.ring import RingWriter
from bench.store.campaigns import CampaignStore, StoredShot
from bench.store.database import open_database
from bench.store.rows import CampaignState, Prompt
from bench.web._campaign_service import CampaignService
from bench.web._last_swing import SwingReader, ended_swing_view, running_swing_view, swing_view
from tests.bench.campaign.plans import NOW
from tests.bench.campaign.report.test_campaign_report import _record
from tests.bench.fake_bench_service import loopback_configuration
from tests.bench.web.conftest import followed_page
from tests.bench.web.running_page import RunningPage
from tests.benchmarks.campaign_statistics import Truth
from tests.waiting import wait_until

RECORDS = Path(__file__).parents[2] / "replay"
SCRIPT = "<script>alert(1)</script>"
OPEN, ENDED = "open-1", "ended-1"
SHOT = f"{ENDED}.000001.parquet"
RECORD = "20260101T000000000000Z-7.parquet"
PROMPT = Prompt(1, 9, "balls", f"Fill the feeder {SCRIPT}", {"balls": [["tour", 1], ["range", 2]]}, NOW)


@pytest.fixture(scope="module")
def configuration(tmp_path_factory: pytest.TempPathFactory) -> Configuration:
    """Return the configuration of a bench with two campaigns, a report and a record."""
    folder, given = tmp_path_factory.mktemp("data"), loopback_configuration()
    taken = _record("symmetry", Truth(sd=1.5, difference=6.0))
    with open_database(database_url("", folder), NOW) as engine:
        store = CampaignStore(engine)
        for name, state in ((OPEN, CampaignState.WAITING), (ENDED, CampaignState.FINISHED)):
            entry = replace(taken.entry, id=name, title=f"Campaign {SCRIPT}")
            store.begin(entry)
            store.add(entry, [StoredShot(shot) for shot in taken.shots])
            store.change(name, state=state)
        store.ask(OPEN, PROMPT)
    report = folder / "campaigns" / ENDED / "report.html"
    report.parent.mkdir(parents=True)
    report.write_text(f"<p>report</p>{SCRIPT}")
    records = folder / "swings" / given.bench.id
    records.mkdir(parents=True)
    (records / RECORD).write_bytes((RECORDS / "swing.parquet").read_bytes())
    shots = folder / "campaigns" / ENDED / "swings"
    shots.mkdir()
    (shots / "000001.parquet").write_bytes((RECORDS / "swing.parquet").read_bytes())
    (shots / "000002.parquet").symlink_to("/etc/passwd")
    os.utime(shots / "000001.parquet", (1.0, 1.0))
    (records / "20260101T000000000000Z-8.parquet").symlink_to("/etc/passwd")
    (folder / "secret").write_text("secret")
    return replace(given, bench=replace(given.bench, data_dir=folder))


@pytest.fixture(scope="module")
def page(configuration: Configuration) -> Iterator[RunningPage]:
    with followed_page(configuration) as page:
        yield page


def service_of(configuration: Configuration) -> CampaignService:
    """Return the campaigns, without programs and downloads."""
    return CampaignService(configuration, Mock(), Mock(), Mock())


def change(page: RunningPage, path: str, seen: float | None = None, **content: Any) -> tuple[int, Any]:
    page.numbers += 1
    at = time.monotonic() if seen is None else seen
    given = {"number": f"campaign-{page.numbers}", "seen": at, "by": "Ann"} | content
    answer = page.post(f"/api/campaign/{path}", given)
    return answer.status, answer.content


def test_archive_lists_campaigns_and_records(page: RunningPage) -> None:
    found = page.ask("GET", "/api/archive").content
    listed = [(one["id"], one["state"], one["report"]) for one in found["campaigns"]]
    assert listed == [(ENDED, "finished", True), (OPEN, "waiting", False)]
    assert [one["name"] for one in found["records"]] == [RECORD, SHOT]


def test_archive_search_filters_by_text(page: RunningPage) -> None:
    def found(text: str) -> tuple[list[str], list[str]]:
        answer = page.ask("GET", f"/api/archive/{text}").content
        return [one["id"] for one in answer["campaigns"]], [one["name"] for one in answer["records"]]

    assert found("ENDED") == ([ENDED], [SHOT])
    assert found("campaign") == ([ENDED, OPEN], [])
    assert found("20260101") == ([], [RECORD])
    assert found("nothing-of-it") == ([], [])


def test_swing_path_shows_listed_records_only(page: RunningPage) -> None:
    assert page.ask("GET", f"/api/swing/{SHOT}").status == 200
    found = page.ask("GET", f"/api/swing/{RECORD}")
    assert found.status == 200
    assert found.content["name"] == RECORD
    assert found.content["figures"]["club_speed_mps"] > 30.0
    assert len(found.content["path"]) > 100
    for name in (
        "none.parquet",
        "20260101T000000000000Z-8.parquet",
        "..%2Fsecret",
        f"{ENDED}.000002.parquet",
    ):
        assert page.ask("GET", f"/api/swing/{name}").status == 404


def test_wear_takes_listed_records_only(page: RunningPage) -> None:
    for records in (None, [], [RECORD] * 31, "all"):
        assert page.post("/api/wear", {"number": "12345678", "records": records}).status == 400
    for name in ("none.parquet", "20260101T000000000000Z-8.parquet", "../secret"):
        assert page.post("/api/wear", {"number": "12345678", "records": [name]}).status == 404


def test_campaign_landing_points_are_hidden_until_end(page: RunningPage) -> None:
    unfinished = page.ask("GET", f"/api/campaign/{OPEN}").content
    assert unfinished["landing"] is None
    assert unfinished["prompt"]["places"] == ["1. tour 1", "2. range 2"]
    ended = page.ask("GET", f"/api/campaign/{ENDED}").content
    assert ended["interim"] is None
    (section,) = ended["landing"]
    assert len(section["points"]) > 10
    assert ended["prompt"] is None
    assert page.ask("GET", "/api/campaign/none").status == 409


def test_report_runs_no_script(page: RunningPage) -> None:
    answer = page.ask("GET", f"/report/{ENDED}")
    assert answer.status == 200
    policy = answer.headers["content-security-policy"]
    assert policy.endswith("sandbox")
    assert "script-src" not in policy
    assert "default-src 'none'" in policy


def test_record_download_is_complete(page: RunningPage) -> None:
    answer = page.ask("GET", f"/record/{RECORD}")
    assert answer.status == 200
    assert answer.body == (RECORDS / "swing.parquet").read_bytes()
    assert answer.headers["content-disposition"].startswith("attachment")


@pytest.mark.parametrize(
    "path",
    [
        "/record/20260101T000000000000Z-8.parquet",  # a link out of the folder
        "/record/..%2f..%2fsecret",
        "/record/%2fetc%2fpasswd",
        "/record/../../secret",
        f"/record/{RECORD}%00",
        f"/record/{RECORD}/../../../secret",
        "/report/..",
        "/report/..%2f..%2fsecret",
        f"/report/{OPEN}",
        "/report/%2e%2e",
    ],
)
def test_record_and_report_paths_outside_archive_are_refused(page: RunningPage, path: str) -> None:
    answer = page.ask("GET", path)
    assert answer.status == 404
    assert b"secret" not in answer.body
    assert b"root" not in answer.body


def test_campaign_requests_reach_runner(page: RunningPage, configuration: Configuration) -> None:
    archive, settings = service_of(configuration), configuration.bench
    assert change(page, f"{OPEN}/pause")[0] == 409  # no runner
    with runner_lock(settings.data_dir, OPEN):
        for name, wanted in (("pause", "pause"), ("resume", ""), ("stop", "stop")):
            status, content = change(page, f"{OPEN}/{name}")
            assert status == 200, content
            with archive.store() as store:
                assert store.standing(OPEN)[2:] == (wanted, "Ann")
        assert archive.details_of(OPEN)["runner"]
        status, content = change(page, f"{OPEN}/resume", seen=time.monotonic() - 60.0)
        assert status == 409  # what moves the robot needs a fresh screen
        assert change(page, f"{OPEN}/pause", seen=time.monotonic() - 60.0)[0] == 200
    assert change(page, f"{ENDED}/stop")[0] == 409


def test_campaign_answer_requires_shown_prompt(page: RunningPage, configuration: Configuration) -> None:
    assert change(page, f"{OPEN}/answer", prompt=2)[0] == 409
    assert change(page, f"{OPEN}/answer", prompt=1, balls=3)[0] == 409
    assert change(page, f"{OPEN}/answer", prompt=1, balls=1.5)[0] == 400
    status, content = change(page, f"{OPEN}/answer", prompt=1, balls=2)
    assert (status, content["note"]) == (200, f"Done: {PROMPT.text}")
    assert change(page, f"{OPEN}/answer", prompt=1)[0] == 409
    with service_of(configuration).store() as store:
        assert store.prompts(OPEN)[0].by == "Ann"


def test_campaign_mark_stores_note(page: RunningPage, configuration: Configuration) -> None:
    status, content = change(page, f"{OPEN}/mark", shot=3, comment=SCRIPT)
    assert status == 200, content
    assert change(page, f"{OPEN}/mark", shot=3, comment="x" * 201)[0] == 400
    assert change(page, f"{OPEN}/mark", shot=10**9)[0] == 400
    assert change(page, f"{OPEN}/mark", shot=10**9, comment="")[0] == 409
    assert change(page, f"{OPEN}/mark", shot=1, comment="", by="")[0] == 400
    assert change(page, f"{OPEN}/delete")[0] == 404
    with service_of(configuration).store() as store:
        assert [(note.shot, note.by, note.text) for note in store.notes(OPEN)] == [(3, "Ann", SCRIPT)]


@pytest.mark.slow
def test_running_campaigns_read_changed_details_only(
    configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive, read = service_of(configuration), list[str]()
    detail = archive.details_of

    def noted(name: str) -> Any:
        read.append(name)
        return detail(name)

    monkeypatch.setattr(archive, "details_of", noted)
    message = {"campaign": OPEN, "shots": 1, "state": "running", "reason": ""}
    for _ in range(2):
        assert archive.running([message])[0]["detail"]["campaign"] == OPEN
    assert read == [OPEN]
    elsewhere = archive.running([message | {"shots": 2}, message | {"campaign": "elsewhere"}])
    assert elsewhere[1]["detail"] is None
    assert read == [OPEN, OPEN, "elsewhere"]
    assert archive.running([]) == []


def test_campaign_archive_without_database_is_empty(tmp_path: Path) -> None:
    given = loopback_configuration()
    archive = service_of(replace(given, bench=replace(given.bench, data_dir=tmp_path)))
    assert archive.listed() == []
    assert list(tmp_path.iterdir()) == []


# The last swing --------------------------------------------------------------------------------------


def test_swing_view_has_figures_and_curves() -> None:
    view = swing_view(RECORDS / "swing.parquet")
    json.dumps(view, allow_nan=False)
    assert 40.0 < view["figures"]["club_speed_mps"] < 50.0
    assert abs(view["speed"]["max_mps"] - view["figures"]["club_speed_mps"]) < 1.0
    assert len(view["path"]) == len(view["time"]) <= 160
    assert [one["name"] for one in view["tracking"]] == ["shoulder", "arm", "wrist"]
    assert [(one["name"], one["side"]) for one in view["pressures"]][:2] == [
        ("shoulder vane", "A"),
        ("shoulder vane", "B"),
    ]
    assert all(1e5 < max(one["pa"]) < 1.2e6 for one in view["pressures"])
    fastest = int(np.argmax(view["speed"]["curve"]))
    assert abs(view["to_ball"] - fastest) < 5
    stopped = swing_view(RECORDS / "stop.parquet")
    assert stopped["figures"]["club_speed_mps"] is None
    assert stopped["reason"]


def test_swing_view_from_ring_matches_stored_record(tmp_path: Path, configuration: Configuration) -> None:
    cycles, metadata = read_swing(RECORDS / "swing.parquet")
    plant, around = plant_of(metadata, "swing")
    begun = int(np.argmax(cycles["state"] == State.SWINGING))
    ring = RingWriter(tmp_path / "ring")
    try:
        for record in cycles[:begun]:
            ring(np.array([record], cycles.dtype))
        assert ended_swing_view(tmp_path / "ring", plant, around) is None
        assert running_swing_view(tmp_path / "ring", plant) is None
        for record in cycles[begun : begun + 800]:
            ring(np.array([record], cycles.dtype))
        running = running_swing_view(tmp_path / "ring", plant)
        for record in cycles[begun + 800 :]:
            ring(np.array([record], cycles.dtype))
        view = ended_swing_view(tmp_path / "ring", plant, around)
    finally:
        ring.close()
    assert running is not None
    assert len(json.dumps(running, allow_nan=False)) < 20_000
    assert (running["running"], running["stored"]) == (True, False)
    assert set(running["figures"].values()) == {None}
    assert 0.5 < running["time"][-1] < 0.8
    assert running["to_ball"] == len(running["time"]) == len(running["speed"]["curve"])
    assert view is not None
    assert not view["running"]
    json.dumps(view, allow_nan=False)
    stored = swing_view(RECORDS / "swing.parquet")
    assert (view["stored"], stored["stored"]) == (False, True)
    assert view["figures"] == pytest.approx(stored["figures"])
    assert view["speed"]["max_mps"] == pytest.approx(stored["speed"]["max_mps"])
    shown: list[tuple[str, Any]] = []
    reader = SwingReader(lambda topic, view: shown.append((topic, view)), configuration.plant)
    reader.start()
    with closing(reader):
        reader.offer_ring(tmp_path / "none")  # a bench on another machine
        wait_until(lambda: shown, nudge=lambda: reader.offer_ring(tmp_path / "ring"))
    assert not shown[0][1]["stored"]


def test_swing_reader_running_swing_keeps_waiting_record(
    tmp_path: Path, configuration: Configuration
) -> None:
    shown: list[Any] = []
    reader = SwingReader(lambda topic, view: shown.append(view), configuration.plant)
    reader.offer(RECORDS / "swing.parquet")
    reader.offer_ring(tmp_path / "ring", running=True)
    reader.start()
    wait_until(lambda: shown)
    reader.close()
    assert shown[0]["stored"]


def test_page_start_shows_newest_record(page: RunningPage) -> None:
    with page.stream() as following:
        assert following("swing")["name"] == RECORD


def test_swing_reader_damaged_record_is_skipped(tmp_path: Path, configuration: Configuration) -> None:
    shown: list[tuple[str, Any]] = []
    reader = SwingReader(lambda topic, view: shown.append((topic, view)), configuration.plant)
    reader.start()
    with closing(reader):
        (tmp_path / "damaged.parquet").write_text("damaged")
        reader.offer(tmp_path / "damaged.parquet")
        wait_until(lambda: shown, nudge=lambda: reader.offer(RECORDS / "swing.parquet"))
    assert shown[0][0] == "swing"
