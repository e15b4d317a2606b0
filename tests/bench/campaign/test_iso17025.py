"""Contents of a signed report (ISO/IEC 17025:2017, 7.8), and its text for missing particulars."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from bench.base.errors import Refused
from bench.campaign.plan.plan import ItemParticulars, StatedCalibration
from bench.campaign.plan.plan_file import load_plan, plan_from_record
from bench.campaign.report.campaign_record import CampaignRecord, load_record
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import findings
from bench.campaign.report.report_tables import calibration_table, issue_report, item_table, particulars
from bench.campaign.run.runner_control import new_entry
from bench.config import database_url
from bench.store.campaigns import CampaignStore, StoredShot
from bench.store.database import open_database
from bench.store.rows import CampaignRun, CampaignState, Event
from tests.bench.campaign.plans import NOW, SHIPPED, with_values
from tests.bench.campaign.report.test_campaign_report import _record, _words
from tests.benchmarks.campaign_statistics import Truth

pytestmark = pytest.mark.usefixtures("undrawn")

PLAN = """
[campaign]
name = "signed"
[design]
balls = ["tour", "range"]
[report]
laboratory = "Robot laboratory"
address = "Hallway 1, Berlin"
customer = "Ball maker Ltd"
operator = "E. Muster"
deviations = ["balls conditioned for 2 h"]
[items.tour]
identity = "Maker X, lot 1234"
condition = "new"
received = "2025-12-20"
[calibrations.monitor]
instrument = "launch monitor"
identity = "no. 77"
source = "certificate 1"
date = "2025-05-04"
due = "2025-12-31"
uncertainty = { ball_speed_mps = 0.1 }
"""


@pytest.fixture(scope="module")
def record() -> CampaignRecord:
    record = _record("symmetry", Truth(sd=1.5, difference=6.0))
    report = {"laboratory": "Robot laboratory", "address": "Hallway 1, Berlin", "customer": "Ball maker Ltd"}
    plan = with_values(record.plan, report=report | {"deviations": ("balls conditioned for 2 h",)})
    items = {"pole": ItemParticulars("Maker X, lot 1234", "new", "2025-12-20")}
    monitor = StatedCalibration("launch monitor", "no. 77", "certificate 1", due="2025-12-31")
    return replace(record, plan=replace(plan, items=items, calibrations={"m": monitor}))


def test_load_plan_reads_laboratory_items_and_calibrations(tmp_path: Path) -> None:
    file = tmp_path / "signed.toml"
    file.write_text(PLAN)
    plan = load_plan(file, SHIPPED)
    assert plan.report.laboratory == "Robot laboratory"
    assert plan.items["tour"].received == "2025-12-20"
    assert plan.calibrations["monitor"].uncertainty == {"ball_speed_mps": 0.1}
    assert plan_from_record(plan.record(), "record") == plan


def test_particulars_draft_states_known_and_missing_facts(record: CampaignRecord) -> None:
    runs = [CampaignRun(1, NOW, "erika@bench1", {}, {})]
    stated = dict(particulars(replace(record, runs=runs), "0123"))
    assert stated["Report number"] == f"{record.entry.id}-draft"
    assert stated["Issued"] == "not issued: a draft"
    assert stated["Laboratory"] == "Robot laboratory, Hallway 1, Berlin"
    assert stated["Operator"] == "erika@bench1"
    assert stated["Sampling"] == "not stated"
    assert stated["Tested"] == "2026-01-01"
    assert stated["Deviations"].startswith("balls conditioned for 2 h; 1 shot does not count; 1 event during")
    assert "guard band" in stated["Decision rule"]
    page = _words(render_campaign_report(record, findings(record.plan, record.shots)))
    for wanted in (
        "The results relate only to the items tested, as received.",
        "Ball maker Ltd",
        "Maker X, lot 1234",
        "launch monitor, no. 77",
        "Uncertainty of the means",
        f"End of report {record.number}.",
    ):
        assert wanted in page, wanted


def test_item_table_lists_items_hit(record: CampaignRecord) -> None:
    rows = {row[0]: row[1:] for row in item_table(record).rows}
    assert rows["pole"] == ("ball", "8, no. 1 to 8", "Maker X, lot 1234", "new", "2025-12-20")
    assert rows["driver"] == ("club", "", "not stated", "not stated", "not stated")


def test_calibration_table_shows_in_force_overdue_and_missing(record: CampaignRecord) -> None:
    entry = {
        "kind": "encoders",
        "version": 2,
        "subject": "",
        "date": "2025-10-01T00:00:00+00:00",
        "expires": "2026-10-01T00:00:00+00:00",
        "by": "Ann",
        "method": "jig",
    }
    calibrations = {"bench": {"in_force": [entry], "nominal": ["valves"]}}
    begun = replace(record.entry, simulated=False, calibrations=calibrations)
    table = calibration_table(replace(record, entry=begun))
    assert table.rows == (
        ("bench encoders", "version 2, jig, by Ann", "2025-10-01", "2026-10-01", "in force"),
        ("bench valves", "none", "–", "–", "nominal: never calibrated"),
        ("launch monitor, no. 77", "certificate 1", "–", "2025-12-31", "OVERDUE since 2025-12-31"),
    )
    assert table.overdue == ("launch monitor, no. 77",)
    page = render_campaign_report(replace(record, entry=begun), findings(record.plan, record.shots))
    assert "Overdue at the tests: launch monitor, no. 77." in page


def test_issue_report_numbers_issues_and_amendment_requires_reason(
    record: CampaignRecord, tmp_path: Path
) -> None:
    entry = new_entry(record.plan, SHIPPED, NOW, simulated=True)
    with open_database(database_url("", tmp_path)) as engine:
        store = CampaignStore(engine)
        store.begin(entry)
        store.add(entry, [StoredShot(shot) for shot in record.shots])
        with pytest.raises(Refused, match="running"):
            issue_report(load_record(store, entry), "Ann", "", NOW)
        store.change(entry.id, state=CampaignState.FINISHED)
        store.note_event(entry.id, issue_report(load_record(store, entry), "Ann", "", NOW))
        first = load_record(store, entry)
        with pytest.raises(Refused, match="--reason"):
            issue_report(first, "Ann", "", NOW)
        amended = issue_report(first, "Bob", "wrong lot", NOW + timedelta(days=2))
        store.note_event(entry.id, amended)
        second = load_record(store, entry)
    assert (first.number, second.number) == (f"{entry.id}-R1", f"{entry.id}-R2")
    assert dict(particulars(first, ""))["Issued"] == "2026-11-21, issued by Ann"
    words = f"2026-11-23, issued by Bob; replaces {first.number}: wrong lot"
    assert dict(particulars(second, ""))["Issued"] == words
    assert [event.date for event in second.issues] == [NOW, datetime(2026, 11, 23, 12, tzinfo=UTC)]


@pytest.mark.slow
def test_campaign_report_issued_shows_number_on_every_page(record: CampaignRecord) -> None:
    issued = replace(record, events=[*record.events, Event(NOW, 41, "issue", "issued by Ann")])
    page = render_campaign_report(issued, findings(issued.plan, issued.shots))
    assert f'@bottom-left {{ content: "Report {record.entry.id}-R1"' in page
    assert "counter(page)" in page
    assert "not issued" not in _words(page)
