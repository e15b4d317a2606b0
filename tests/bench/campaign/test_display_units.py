"""Units of a report: one system in all of it, the figures those of SI converted."""

from __future__ import annotations

import re
from math import inf, nan

import pytest

from bench.campaign.plan.plan import NAMES
from bench.campaign.report.campaign_record import CampaignRecord
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import QUANTITIES, findings
from bench.campaign.report.report_format import BALL, CLUB, UnitSystem, display_unit, number_text, two_digits
from tests.bench.campaign.report.test_campaign_report import _record, _words
from tests.benchmarks.campaign_statistics import Truth

pytestmark = pytest.mark.usefixtures("undrawn")

SI_ONLY = re.compile(r"\d (?:m|m/s|mm|°C|hPa|g)\b(?!²)")
US_ONLY = re.compile(r"\d (?:yd|mph|in|°F|inHg|oz)\b")


@pytest.fixture(scope="module")
def record() -> CampaignRecord:
    return _record("symmetry", Truth(sd=1.5, difference=6.0))


def _page(record: CampaignRecord, units: UnitSystem) -> str:
    return render_campaign_report(record, findings(record.plan, record.shots, None, units), units)


def _figures(page: str) -> str:
    """Return the text before the set-up, which is a record; and the labels of pictures are paths."""
    return _words(page[: page.index('id="setup"')])


@pytest.mark.parametrize(("units", "foreign"), [(UnitSystem.SI, US_ONLY), (UnitSystem.US, SI_ONLY)])
def test_campaign_report_uses_one_unit_system(
    record: CampaignRecord, units: UnitSystem, foreign: re.Pattern[str]
) -> None:
    page = _figures(_page(record, units))
    assert foreign.findall(page) == []
    heads = re.findall(r"<small>([^<]+)</small>", _page(record, units))
    wanted = {"yd", "mph", "in"} if units is UnitSystem.US else {"m", "m/s", "mm"}
    other = {"m", "m/s", "mm"} if units is UnitSystem.US else {"yd", "mph", "in"}
    assert wanted <= set(heads)
    assert not other & set(heads)


def test_campaign_report_us_units_convert_verdict(record: CampaignRecord) -> None:
    pair = findings(record.plan, record.shots).sections[0].analysis.confirmatory.pairs[0]  # type: ignore[union-attr]
    page = _words(_page(record, UnitSystem.US))
    assert f"pole has {pair.difference / 0.9144:.2f} yd more carry (launch monitor) than seam" in page
    assert "find a difference of 4 yd" in page
    assert "77.0 °F, 29.92 inHg, 50 %" in page


def test_display_unit_every_quantity_has_consistent_units() -> None:
    columns = {*NAMES, *QUANTITIES, *CLUB, *BALL}
    for column in columns:
        si, us = (display_unit(column, units) for units in UnitSystem)
        assert (si.unit == us.unit) == (si.size == us.size)


def test_display_unit_formats_figures_as_text() -> None:
    assert display_unit("carry_m", UnitSystem.US).text(182.88) == "200.0"
    assert display_unit("air_temperature_k", UnitSystem.US).text(296.15) == "73.4"
    assert display_unit("carry_side_m").text(-0.04) == "0.0"
    assert display_unit("carry_m").text(None) == "–"
    assert [number_text(value, 1) for value in (nan, inf, -inf, -2.25)] == ["–", "∞", "−∞", "−2.2"]
    assert [two_digits(value) for value in (0.0123, 1.26, 126.0, 0.0, nan)] == [
        "0.012",
        "1.3",
        "126",
        "0",
        "–",
    ]
