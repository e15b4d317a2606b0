"""Shots excluded by hand: traceable, never deleted, taken back by another word on them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from bench.base.errors import Refused
from bench.campaign.report.campaign_record import (
    ISSUE,
    MAX_REASON_LENGTH,
    CampaignRecord,
    exclude_shot,
    load_record,
    with_exclusions,
)
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import findings
from bench.campaign.report.verification import verify_page
from bench.config import database_url
from bench.records.shot.shot import ShotStatus
from bench.store.campaigns import CampaignStore, StoredShot
from bench.store.database import open_database
from bench.store.rows import CampaignState, Event, ShotExclusion
from tests.bench.campaign.plans import NOW
from tests.bench.campaign.report.test_campaign_report import _record
from tests.benchmarks.campaign_statistics import Truth

pytestmark = pytest.mark.usefixtures("undrawn")

LATER = NOW + timedelta(days=3)


@pytest.fixture(scope="module")
def taken() -> CampaignRecord:
    return _record("symmetry", Truth(sd=1.5, difference=6.0))


@pytest.fixture
def store(taken: CampaignRecord, tmp_path: Path) -> Iterator[CampaignStore]:
    with open_database(database_url("", tmp_path), NOW) as engine:
        found = CampaignStore(engine)
        found.begin(taken.entry)
        found.add(taken.entry, [StoredShot(shot) for shot in taken.shots])
        found.change(taken.entry.id, state=CampaignState.FINISHED)
        yield found


def _page(store: CampaignStore, campaign: str) -> str:
    record = load_record(store, store.entry(campaign))
    return render_campaign_report(record, findings(record.plan, record.shots, []))


@pytest.mark.slow
def test_exclude_shot_changes_results_and_keeps_record(store: CampaignStore, taken: CampaignRecord) -> None:
    campaign, before = taken.entry.id, store.shots(taken.entry.id)
    page = _page(store, campaign)
    exclude_shot(store, campaign, 9, " leaf on the <tee> ", "Ann", LATER)
    assert store.shots(campaign) == before
    record = load_record(store, store.entry(campaign))
    assert record.shots[8] == replace(
        before[8].shot, status=ShotStatus.EXCLUDED, reason="excluded by hand: leaf on the <tee>"
    )
    assert record.shots_as_taken == [stored.shot for stored in before]
    (section,) = findings(record.plan, record.shots, []).sections
    counted = {level.name: (level.valid, level.excluded) for level in section.analysis.levels}
    (whole,) = findings(taken.plan, taken.shots, []).sections
    for level in whole.analysis.levels:
        gone = level.name == before[8].shot.ball
        assert counted[level.name] == (level.valid - gone, level.excluded + gone)
    found = verify_page(record, page, "report.html").differences
    assert any(line.startswith("exclusions: not as reported") for line in found)
    assert "shot 9: not as reported" in found
    again = _page(store, campaign)
    assert verify_page(record, again, "report.html").differences == ()
    assert "(1 by hand)" in again
    assert "leaf on the &lt;tee&gt;" in again
    assert "With these shots the result would" in again


def test_verify_page_names_shots_excluded_after_issue_first(
    store: CampaignStore, taken: CampaignRecord
) -> None:
    campaign = taken.entry.id
    exclude_shot(store, campaign, 9, "leaf", "Ann", LATER - timedelta(hours=2))
    store.note_event(campaign, Event(LATER - timedelta(hours=1), len(taken.shots), ISSUE, "Ann"))
    page = _page(store, campaign)
    exclude_shot(store, campaign, 12, "leaf", "Ann", LATER)
    exclude_shot(store, campaign, 9, "no leaf", "Ann", LATER, undo=True)
    found = verify_page(load_record(store, store.entry(campaign)), page, "report.html").differences
    action = f"issue an amendment: golfbench campaign report {campaign} --issue --reason TEXT"
    assert found[0] == f"shots excluded after the issue: 12; {action}"
    assert found[1] == f"shots counted again after the issue: 9; {action}"


def test_exclude_shot_undo_is_listed_in_report(store: CampaignStore, taken: CampaignRecord) -> None:
    campaign = taken.entry.id
    exclude_shot(store, campaign, 9, "leaf on the tee", "Ann", LATER)
    exclude_shot(store, campaign, 9, "it was shot 10", "Bob", LATER, undo=True)
    record = load_record(store, store.entry(campaign))
    assert list(record.shots) == list(taken.shots)
    assert [(one.by, one.excluded, one.after_shot) for one in record.exclusions] == [
        ("Ann", True, len(taken.shots)),
        ("Bob", False, len(taken.shots)),
    ]
    page = _page(store, campaign)
    assert "by hand)" not in page
    assert "it was shot 10" in page
    assert "counts again" in page
    assert verify_page(record, page, "report.html").differences == ()


@pytest.mark.slow
def test_campaign_report_exclusion_states_previous_look(taken: CampaignRecord) -> None:
    def seen(exclusion: ShotExclusion, *looks: Event, state: CampaignState = CampaignState.STOPPED) -> str:
        shots = with_exclusions(taken.shots, [exclusion])
        record = replace(
            taken,
            shots=shots,
            events=looks,
            exclusions=[exclusion],
            standing=taken.standing._replace(state=state),
        )
        page = render_campaign_report(record, findings(record.plan, shots, []))
        row, *_ = re.findall("a gust</td>(.*?)</tr>", page.split("<h3>Excluded by hand")[1])
        return str(re.findall(">([^<]*)</td>", row)[-1])

    last = len(taken.shots)
    exclusion = ShotExclusion(9, LATER, "Ann", "a gust", True, 20)
    look = Event(LATER - timedelta(1), 11, "look", "interim analysis of 10 shots: report")
    assert seen(exclusion) == "no"
    assert seen(exclusion, look) == "yes"
    assert seen(exclusion, look._replace(date=LATER + timedelta(1))) == "no"
    assert seen(exclusion, state=CampaignState.FINISHED) == "no"
    assert seen(exclusion._replace(after_shot=last), state=CampaignState.FINISHED) == "yes"


@pytest.mark.parametrize(
    ("shot", "reason", "by", "undo", "message"),
    [
        (9, " ", "Ann", False, "a reason of 0 characters"),
        (9, "x" * (MAX_REASON_LENGTH + 1), "Ann", False, "a reason of 501 characters"),
        (9, "a gust", " ", False, "no name"),
        (999, "a gust", "Ann", False, "no such shot"),
        (9, "a gust", "Ann", True, "not excluded by hand"),
        (8, "a gust", "Ann", False, "excluded by hand already"),
    ],
)
def test_exclude_shot_invalid_request_is_refused(
    store: CampaignStore, taken: CampaignRecord, shot: int, reason: str, by: str, undo: bool, message: str
) -> None:
    exclude_shot(store, taken.entry.id, 8, "a leaf", "Ann", NOW)
    with pytest.raises(Refused, match=message):
        exclude_shot(store, taken.entry.id, shot, reason, by, NOW, undo=undo)
    assert len(store.exclusions(taken.entry.id)) == 1


def test_exclude_shot_failed_shot_is_refused(store: CampaignStore, taken: CampaignRecord) -> None:
    failed = replace(taken.shots[-1], shot=99, status=ShotStatus.FAILED, reason="no ball on the tee")
    store.add(taken.entry, [StoredShot(failed)])
    with pytest.raises(Refused, match="failed already: no ball on the tee"):
        exclude_shot(store, taken.entry.id, 99, "a gust", "Ann", NOW)
