"""A report matches its records: each change of either is reported."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from bench.base.errors import BenchError
from bench.campaign.report.campaign_record import CampaignRecord, record_digests
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import findings
from bench.campaign.report.report_format import UnitSystem
from bench.campaign.report.verification import missing_records, verify_page
from bench.store.campaigns import StoredShot
from bench.store.rows import Event, Hit, ShotNote
from tests.bench.campaign.plans import NOW
from tests.bench.campaign.report.test_campaign_report import _record
from tests.benchmarks.campaign_statistics import Truth
from tests.sampling import release_except

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def record() -> CampaignRecord:
    return _record("symmetry", Truth(sd=1.5, difference=6.0))


@pytest.fixture(scope="module", params=release_except({UnitSystem.SI}, UnitSystem))
def page(record: CampaignRecord, request: pytest.FixtureRequest) -> str:
    units: UnitSystem = request.param
    return render_campaign_report(record, findings(record.plan, record.shots, [20], units), units)


def _differences(record: CampaignRecord, page: str) -> tuple[str, ...]:
    return verify_page(record, page, "report.html").differences


def test_verify_page_unchanged_report_has_no_differences(record: CampaignRecord, page: str) -> None:
    found = verify_page(record, page, "report.html")
    assert found.differences == ()
    assert found.figures > 200
    assert found.page
    assert found.digest == record_digests(record).whole
    assert page.count(found.digest) == 2


def test_verify_page_changed_shot_is_named_with_figures(record: CampaignRecord, page: str) -> None:
    shots = [*record.shots]
    shots[6] = replace(shots[6], carry_m=(shots[6].carry_m or 0) + 0.001)
    found = _differences(replace(record, shots=shots), page)
    assert any(line.startswith("shots: not as reported") for line in found)
    assert "shot 7: not as reported" in found
    assert not any(line.startswith("shot 8") for line in found)
    assert any(line.startswith("sections.0.") for line in found)
    assert "page: not the one that the records give" in found
    later = _differences(replace(record, shots=record.shots[:-2]), page)
    assert "shots: 40 in the report, 38 in the records" in later


def test_verify_page_changed_page_is_reported(record: CampaignRecord, page: str) -> None:
    head, tail = page.split("Repeatability:", 1)
    edited = f"{head}Repeatability:{re.sub(r'>(0[.][0-9]+)<', '>0.001<', tail, count=1)}"
    restyled = page.replace("</style>", ".verdict { display: none; }</style>", 1)
    redrawn = re.sub(r'(<svg aria-hidden.*?<path d="M )[0-9.]+', r"\g<1>1.0", page, count=1, flags=re.DOTALL)
    for changed in (edited, restyled, redrawn):
        assert changed != page
        assert _differences(record, changed) == ("page: not the one that the records give",)


def test_verify_page_changed_figures_and_digest_are_named(record: CampaignRecord, page: str) -> None:
    mean = re.search(r'"mean":(1[78][0-9][.][0-9]+)', page)
    assert mean is not None
    found = _differences(record, page.replace(mean[0], '"mean":170.5'))
    assert any("170.5 in the report" in line for line in found)
    digest = record_digests(record).whole
    assert any(line.startswith("digest") for line in _differences(record, page.replace(digest, "0" * 64)))
    assert any(line.startswith("digest") for line in _differences(record, page.replace(digest, "0" * 64, 1)))


def test_verify_page_changed_plan_events_or_notes_are_named(record: CampaignRecord, page: str) -> None:
    entry = replace(record.entry, plan={**record.entry.plan, "gate": {}})
    assert any(line.startswith("plan:") for line in _differences(replace(record, entry=entry), page))
    gone = replace(record, events=())
    assert any(line.startswith("events:") for line in _differences(gone, page))
    noted = replace(record, notes=[ShotNote(3, NOW, "Ann", "a gust")])
    assert any(line.startswith("notes:") for line in _differences(noted, page))


def test_verify_page_later_hits_and_issues_change_nothing(record: CampaignRecord, page: str) -> None:
    later = replace(record, hits=record.hits + record.hits)
    assert later.hits[Hit("ball", "tour", 1)] == 8
    assert _differences(later, page) == ()
    issued = replace(record, events=[*record.events, Event(NOW + timedelta(1), 41, "issue", "issued by Ann")])
    assert _differences(issued, page) == ()
    again = render_campaign_report(issued, findings(issued.plan, issued.shots))
    assert f"test report {record.entry.id}-R1<" in again
    assert _differences(issued, again) == ()


@pytest.mark.parametrize(
    "text", ["", "<html></html>", '<script type="application/json" id="record">{</script>']
)
def test_verify_page_without_report_data_is_refused(record: CampaignRecord, text: str) -> None:
    with pytest.raises(BenchError, match="no data of a report"):
        verify_page(record, text, "x.html")


def test_verify_page_report_of_other_campaign_is_refused(record: CampaignRecord, page: str) -> None:
    other = replace(record, entry=replace(record.entry, id="another"))
    with pytest.raises(BenchError, match="that of another"):
        verify_page(other, page, "x.html")


def test_verify_page_other_software_compares_figures_only(record: CampaignRecord, page: str) -> None:
    other = re.sub(r'"software":"[0-9a-f]+"', '"software":"0"', page)
    found = verify_page(
        record, re.sub(r'"headline":"[^"]+"', '"headline":"In other words."', other), "x.html"
    )
    assert found.differences == ()
    assert not found.page


def test_missing_records_names_missing_and_truncated_files(record: CampaignRecord, tmp_path: Path) -> None:
    for name in ("1.parquet", "2.parquet"):
        (tmp_path / name).write_bytes(b"12345")
    stored = [
        StoredShot(record.shots[0], "1.parquet", 5),
        StoredShot(record.shots[1], "2.parquet", 9),
        StoredShot(record.shots[2], "3.parquet", 5),
        StoredShot(record.shots[3]),
    ]
    assert missing_records(stored, tmp_path) == [
        "shot 2: record 2.parquet has 5 bytes, stored 9",
        "shot 3: record 3.parquet is missing",
    ]
