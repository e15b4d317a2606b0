"""The campaign's report: verdict first, nothing from elsewhere, the same bytes again, read by a browser."""

from __future__ import annotations

import json
import re
import subprocess
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import pytest

from bench.base.errors import BenchError
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.report.campaign_record import CampaignRecord
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import Findings, findings, findings_record
from bench.campaign.report.report_format import UnitSystem
from bench.campaign.run.runner import RunOutcome
from bench.campaign.run.runner_control import new_entry
from bench.commands.campaign.campaign_baseline import Band, check_baseline, junit_xml, read_baseline
from bench.records.shot.shot import ShotStatus
from bench.store.rows import CampaignState, Event, Hit, Prompt, Standing
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from tests.bench.campaign.plans import NOW, SHIPPED, with_values
from tests.bench.swing.test_profile import FOLLOWED
from tests.bench.web.chromium import launched
from tests.benchmarks.campaign_statistics import Truth, campaign_shots

THREE_BY_TWO = """
[campaign]
name = "three-by-two"
title = "Three balls with two clubs"
[design]
compare = "ball"
balls = ["tour", "range", "slow"]
clubs = ["driver", "driver-12"]
[analysis]
carry = "monitor"
target_difference = 2.0
drift = "none"
[balls.slow]
like = "tour"
[clubs.driver-12]
like = "driver"
"""


def _record(name: str, truth: Truth, blocks: int = 8) -> CampaignRecord:
    plan = with_values(load_plan(Path(name), SHIPPED), design={"blocks": blocks})
    shots = [
        replace(
            shot,
            club_speed_mps=42.9 + 0.01 * (n % 7),
            attack_angle_deg=0.5,
            dynamic_loft_deg=11.1,
            strike_x_mm=0.1 * (n % 5),
            ball_speed_mps=62.0 + 0.01 * n,
            carry_side_m=-2.0 + n % 9 / 9,
            total_m=190.0,
            delivery_source="simulated",
            air_temperature_k=298.15,
            air_pressure_pa=101325.0,
            relative_humidity=0.5,
        )
        for n, shot in enumerate(campaign_shots(plan, truth, 1))
    ]
    shots[5] = replace(shots[5], status=ShotStatus.EXCLUDED, reason="the launch monitor saw <no> ball")
    entry = new_entry(plan, SHIPPED, NOW, simulated=True)
    standing = Standing(CampaignState.FINISHED, "", "")
    events = [Event(NOW, 3, "guard", "guard opened")]
    return CampaignRecord(entry, standing, plan, shots, events, Counter({Hit("ball", "tour", 1): 4}))


@pytest.fixture(scope="module")
def record() -> CampaignRecord:
    return _record("symmetry", Truth(sd=1.5, difference=6.0))


@pytest.fixture(scope="module")
def found(record: CampaignRecord) -> Findings:
    return findings(record.plan, record.shots)


@pytest.fixture(scope="module")
def text(record: CampaignRecord, found: Findings) -> str:
    return render_campaign_report(record, found)


@pytest.fixture(scope="module")
def three_by_two(tmp_path_factory: pytest.TempPathFactory) -> CampaignRecord:
    """Three balls with two clubs in four blocks."""
    file = tmp_path_factory.mktemp("plan") / "plan.toml"
    file.write_text(THREE_BY_TWO)
    return _record(str(file), Truth(sd=0.5, difference=6.0), 4)


def _words(text: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", "", re.sub(r"<(svg|style).*?</\1>", "", text, flags=re.S)))


@pytest.mark.slow
def test_campaign_report_verdict_precedes_tables_and_figures(text: str) -> None:
    verdict = text.index("pole has")
    assert verdict < text.index("<table")
    assert verdict < text.index("<svg")
    assert "m more carry (launch monitor) than seam" in text


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_first_page_has_verdict_for_each_club(three_by_two: CampaignRecord) -> None:
    page = render_campaign_report(three_by_two, findings(three_by_two.plan, three_by_two.shots))
    first = page[: page.index('id="s1"')]
    words = _words(first)
    for wanted in (
        "golfbench · simulated · test report",
        "driver: 2 of 3 pairs differ in carry (launch monitor): ",
        "driver-12: 2 of 3 pairs differ in carry (launch monitor): ",
        " &gt; ",
        "Balls by club: difference to tour in carry (launch monitor), m",
        "4 balls, 4 shots",
        "different",
        "The interaction of ball and club was not tested",
        "Other quantities (ball speed, launch angle, spin, landing angle, apex, total distance, offline)",
    ):
        assert wanted in words, wanted
    assert first.count("<figure") == 1
    assert first.index("<figure") < first.index("<table")
    assert 'aria-label="Differences of all balls to tour' in first


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_counts_shots_by_role_and_names_carry_source(three_by_two: CampaignRecord) -> None:
    shots = [replace(shot, carry_source="monitor") for shot in three_by_two.shots]
    shots[:3] = [replace(shot, role="warm-up") for shot in shots[:3]]
    page = render_campaign_report(replace(three_by_two, shots=shots), findings(three_by_two.plan, shots))
    words = _words(page)
    assert "24 shots (21 test, 3 warm-up): 23 valid, 1 excluded" in words
    assert "Carry: monitor – as the launch monitor reported it." in words


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_compared_clubs_show_gap_to_next() -> None:
    clubs = _record("clubs", Truth(difference=12.0), 4)
    found = findings(clubs.plan, clubs.shots)
    page = _words(render_campaign_report(clubs, found))
    means = sorted((level.spread.mean for level in found.sections[0].analysis.levels), reverse=True)
    assert "gapto the next" in page
    for longer, shorter in pairwise(means):
        assert f"{longer - shorter:.2f}" in page


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_captions_state_only_drawn_items(
    record: CampaignRecord, three_by_two: CampaignRecord, found: Findings
) -> None:
    plain = replace(
        three_by_two, shots=[replace(s, status=ShotStatus.VALID, reason="") for s in three_by_two.shots]
    )
    words = _words(render_campaign_report(plain, findings(plain.plan, plain.shots)))
    for absent in ("Crosses: control ball", "open: not valid", "Ringed", "Grey band", "Red lines"):
        assert absent not in words, absent
    words = _words(render_campaign_report(record, found))
    for there in ("Crosses: control ball", "open: not valid", "Ellipse: holds 95 %"):
        assert there in words, there


def test_campaign_report_ends_with_appendices(text: str) -> None:
    heads = re.findall(r"<h2[^>]*>([^<]*)</h2>", text)[-3:]
    assert heads == [
        f"Appendix: {part}" for part in ("all shots", "balls and clubs", "plan and configuration")
    ]


def test_campaign_report_contains_identity_conditions_and_events(text: str, record: CampaignRecord) -> None:
    words = _words(text)
    for wanted in (
        record.entry.id,
        record.entry.digest,
        "Seed",
        "guard opened",
        "Every figure is simulated",
        "Tested by, date",
        "Symmetry: pole against seam",
        "25.0 °C, 1013 hPa, 50 %",
        "scipy",
        "drift removed by the control",
        "intermediate precision SD",
        "ball tour",
        "plan.design",
    ):
        assert wanted in words, wanted
    assert "saw &lt;no&gt; ball" in text


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_names_followed_golfer_with_deviation(
    record: CampaignRecord, found: Findings, text: str
) -> None:
    default = load_profile(find_profile("default"))
    profiles = {("default", "driver"): replace(default, golfer="Anna", followed=FOLLOWED)}
    entry = new_entry(record.plan, SHIPPED, NOW, simulated=True, profiles=profiles)
    followed = replace(record, entry=entry)
    words = _words(render_campaign_report(followed, found))
    assert words.count("Anna") == 2
    for wanted in ("Anna, 5e1f…", "club", "4.5 % 5.7°", "5.3 % 5.2°", "3.4 % 83 mm", "“aligned” at the ball"):
        assert wanted.replace("“", "&#34;").replace("”", "&#34;") in words, wanted
    assert "golfer" not in _words(text).lower()


def test_campaign_report_loads_no_external_resource(text: str) -> None:
    assert "default-src 'none'" in text
    for address in re.findall(r'(?:src|href|url\()=?"?([^")> ]+)', text):
        assert address.startswith(("#", "data:")), address


def test_campaign_report_same_record_gives_same_bytes(text: str, record: CampaignRecord) -> None:
    assert render_campaign_report(record, findings(record.plan, record.shots)) == text


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_ids_are_unique(text: str) -> None:
    record = _record("clubs", Truth(), 3)
    for page in (text, render_campaign_report(record, findings(record.plan, record.shots))):
        ids = re.findall(r'\bid="([^"]+)"', page)
        assert len(ids) == len(set(ids))


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_unfinished_campaign_is_stated_first(record: CampaignRecord, found: Findings) -> None:
    standing = Standing(CampaignState.SUSPENDED, "balls used up", "")
    page = render_campaign_report(replace(record, standing=standing), found)
    assert "This campaign is not finished: suspended (balls used up)" in page
    assert page.index("not finished") < page.index("pole has")


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_one_level_renders_and_no_shots_is_refused() -> None:
    record = _record("repeatability", Truth())
    page = _words(render_campaign_report(record, findings(record.plan, record.shots)))
    assert "tour: club speed 42.9" in page
    with pytest.raises(ValueError, match="at least one shot"):
        render_campaign_report(replace(record, shots=[]), findings(record.plan, []))


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_long_lists_state_omitted_count(record: CampaignRecord, found: Findings) -> None:
    events = [Event(NOW, n, "guard", f"guard opened, number {n}.") for n in range(1, 251)]
    prompts = [Prompt(n, n, "club", f"Mount it, number {n}.", {}, NOW, NOW, "erika") for n in range(1, 203)]
    invalid = [
        replace(shot, shot=n, status=ShotStatus.EXCLUDED, reason="lost")
        for n, shot in enumerate([*record.shots[:11]] * 100, 1)
    ]
    many = replace(record, shots=invalid, events=events, prompts=prompts)
    page = _words(render_campaign_report(many, found))
    assert "number 200." in page
    assert "and 50 more" in page
    assert "and 2 more" in page
    assert "The first 1000 of 1100 of these" in page
    short = _words(render_campaign_report(record, found))
    assert " more" not in short.split("Events")[1].split("Limits")[0]


def test_campaign_report_plots_render_names_in_any_script(record: CampaignRecord) -> None:
    balls = {"pole": "飛び", "seam": "공 ①"}
    shots = [replace(shot, ball=balls.get(shot.ball, shot.ball)) for shot in record.shots]
    design = replace(record.plan.design, balls=tuple(balls.values()))
    renamed = [replace(ball, name=balls.get(name, name)) for name, ball in record.plan.balls.items()]
    known = {ball.name: ball for ball in renamed}
    plan = replace(record.plan, design=design, balls=known)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        page = render_campaign_report(replace(record, plan=plan, shots=shots), findings(plan, shots))
    pictures = re.findall(r"<svg.*?</svg>", page, flags=re.S)
    assert sum("飛び</text>" in picture for picture in pictures) >= 2


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_several_days_show_dates(record: CampaignRecord) -> None:
    shots = [replace(shot, time_utc=NOW + timedelta(hours=n)) for n, shot in enumerate(record.shots)]
    events = [Event(NOW + timedelta(hours=9), 5, "killed", "the runner had ended")]
    page = _words(
        render_campaign_report(replace(record, shots=shots, events=events), findings(record.plan, shots))
    )
    assert "2026-11-22 03:00:00" in page
    assert "before shot 5, 2026-11-21 21:00:00: the runner had ended" in page


def test_findings_record_holds_report_figures(found: Findings) -> None:
    figures = json.loads(json.dumps(findings_record(found), allow_nan=False))
    (pair,) = figures["sections"][0]["confirmatory"]["pairs"]
    assert pair["verdict"] == "different"
    assert figures["by_status"] == {"valid": 39, "excluded": 1}
    (section,) = figures["sections"]
    assert [(one["name"], one["letters"]) for one in section["ranking"]] == [("pole", "a"), ("seam", "b")]
    assert section["dispersion"][0]["area_low"] < section["dispersion"][0]["area"]
    assert [chart["column"] for chart in section["control_charts"]] == ["carry_m", "ball_speed_mps"]
    carry = section["quantities"][0]["spreads"]["carry_m"]
    assert carry["mean"] == pytest.approx(section["levels"][0]["spread"]["mean"])
    assert f"{pair['difference']:.2f}" in figures["sections"][0]["verdicts"][0]["headline"]


def test_check_baseline_reports_figures_outside_band(found: Findings, tmp_path: Path) -> None:
    figures = findings_record(found)
    file = tmp_path / "baseline.toml"
    file.write_text(
        '[[figure]]\npath = "sections.0.levels.pole.spread.mean"\nlow = 170\nhigh = 190\n'
        '[[figure]]\npath = "by_status.valid"\nlow = 40\n'
        '[[figure]]\npath = "repeatability.driver.figures.club_speed_mps.within.sd"\nhigh = 0.5\n'
        '[[figure]]\npath = "sections.7.name"\nhigh = 1\n'
    )
    checks = check_baseline(figures, read_baseline(file))
    assert [check.holds for check in checks] == [True, False, True, False]
    assert str(checks[1]) == "by_status.valid: 39, band 40 to inf"
    assert "not there" in str(checks[3])
    assert not check_baseline({"x": None}, [Band("x", -1.0, 1.0)])[0].holds


@pytest.mark.parametrize(
    "content",
    [
        "",
        "x = 1",
        "[[figure]]\nlow = 1",
        '[[figure]]\npath = "a"',
        '[[figure]]\npath = "a"\nlow = nan',
        '[[figure]]\npath = "a"\nlow = 2\nhigh = 1',
        '[[figure]]\npath = "a"\nlow = 2\nhihg = 1',
    ],
)
def test_read_baseline_invalid_file_is_refused(tmp_path: Path, content: str) -> None:
    file = tmp_path / "baseline.toml"
    file.write_text(content)
    with pytest.raises((BenchError, ExceptionGroup)):
        read_baseline(file)


def test_junit_xml_has_case_for_each_planned_shot_and_band(record: CampaignRecord) -> None:
    from xml.etree import ElementTree

    outcome = RunOutcome(CampaignState.STOPPED, "stopped by request", 40, 39)
    checks = check_baseline({"x": 3}, [Band("x", 0.0, 1.0)])
    suite = ElementTree.fromstring(junit_xml(record.entry, outcome, record.shots, checks))  # noqa: S314
    cases = suite.findall("testcase")
    failed = {case.get("name"): case[0].get("message") for case in cases if len(case)}
    assert len(cases) == 40 + 2 == int(suite.get("tests", ""))
    assert len(failed) == 3 == int(suite.get("failures", ""))
    assert failed["came to its end"] == "stopped by request"
    assert failed["x"] == "x: 3, band 0 to 1"


@pytest.mark.requires("chromium")
def test_campaign_report_chromium_shows_and_prints_without_errors(
    record: CampaignRecord, tmp_path: Path, tool: Callable[[str], str]
) -> None:
    page, pdf = tmp_path / "report.html", tmp_path / "report.pdf"
    page.write_text(render_campaign_report(record, findings(record.plan, record.shots)))
    done = _browse(tool("chromium"), tmp_path, f"--print-to-pdf={pdf}", page)
    assert pdf.read_bytes().startswith(b"%PDF")
    assert "CONSOLE" not in done.stderr
    shown = _browse(tool("chromium"), tmp_path, "--dump-dom", page).stdout
    assert "m more carry (launch monitor) than seam" in shown


WIDER = """() => [...document.querySelectorAll("main *")].filter(one => !one.closest("svg")
    && one.getBoundingClientRect().right > document.documentElement.clientWidth + 1).length"""
"""Number of elements that stick out on the right."""


@pytest.mark.requires("chromium")
def test_campaign_report_fits_screen_and_paper_width(
    three_by_two: CampaignRecord, tmp_path: Path, tool: Callable[[str], str]
) -> None:
    """The column of carry, and the verdicts of nine clubs, were cut off on the right."""
    from playwright.sync_api import sync_playwright

    clubs = _record("clubs-split-plot", Truth(sd=1.5, difference=106.0))
    every = {record.plan.campaign.name: _delivered(record) for record in (three_by_two, clubs)}
    with sync_playwright() as playwright:
        browser = launched(playwright, tool("chromium"))
        page, sheets = browser.new_page(), {}
        for (name, record), units in product(every.items(), UnitSystem):
            text = render_campaign_report(record, findings(record.plan, record.shots, None, units), units)
            page.set_content(text.replace("driver-12", "wedge56-55yd"))
            for width, medium in ((390, "screen"), (768, "screen"), (1280, "screen"), (688, "print")):
                page.emulate_media(media=medium)
                page.set_viewport_size({"width": width, "height": 800})
                assert page.evaluate(WIDER) == 0, (name, units, width, medium)
                assert page.evaluate("document.documentElement.scrollWidth") == width
            sheets[name] = len(re.findall(rb"/Type\s*/Page\b", page.pdf(prefer_css_page_size=True)))
            page.set_viewport_size({"width": 1280, "height": 800})
            page.emulate_media(media="screen")
            assert page.locator("figure").first.bounding_box()["y"] < 500
        browser.close()
    assert len(three_by_two.shots) == 24
    assert sheets["three-by-two"] <= 8


def _delivered(record: CampaignRecord) -> CampaignRecord:
    """Return the record with figures as wide as measured ones."""
    shots = [
        replace(
            shot,
            club_path_deg=-1.25,
            face_angle_deg=0.21,
            strike_y_mm=-11.5,
            direction_deg=-0.87,
            spin_axis_deg=-10.42,
            launch_angle_deg=12.65 + 0.03 * (n % 5),
            spin_rpm=2402.0 + 99 * (n % 7),
            landing_angle_deg=35.6 + 0.05 * (n % 5),
            apex_m=23.0 + 0.05 * (n % 5),
            total_m=231.5 + 0.05 * (n % 5),
            carry_side_m=-10.7 + 0.05 * (n % 5),
        )
        for n, shot in enumerate(record.shots)
    ]
    return replace(record, shots=shots)


def _browse(chromium: str, folder: Path, action: str, page: Path) -> subprocess.CompletedProcess[Any]:
    options = (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--host-resolver-rules=MAP * ~NOTFOUND",
        "--no-first-run",
        "--enable-logging=stderr",
        f"--user-data-dir={folder / 'profile'}",
    )
    command = [chromium, *options, action, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_lists_prompts_with_operator(record: CampaignRecord) -> None:
    prompts = [
        Prompt(1, 1, "balls", "Fill the feeder in this order: tour 1.", {}, NOW, NOW, "Ann"),
        Prompt(2, 4, "club", "Mount club iron.", {}, NOW, NOW, "simulation"),
        Prompt(3, 7, "club", "Mount club wood.", {}, NOW),
    ]
    real = replace(record, entry=replace(record.entry, simulated=False), prompts=prompts)
    page = _words(render_campaign_report(real, findings(real.plan, real.shots)))
    assert "confirmed by Ann" in page
    assert "before shot 1, 12:00:00: Fill the feeder in this order: tour 1. Ann, 12:00:00" in page
    assert "1 times club: done by the simulation itself" in page
    assert "Mount club wood. not done yet" in page
    nobody = replace(real, prompts=())
    assert "not confirmed" in _words(render_campaign_report(nobody, findings(real.plan, real.shots)))


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_report_changing_air_shows_range(record: CampaignRecord) -> None:
    shots = [replace(record.shots[0], air_temperature_k=295.15), *record.shots[1:]]
    page = _words(render_campaign_report(replace(record, shots=shots), findings(record.plan, shots)))
    assert "22.0 to 25.0 °C, 1013 hPa, 50 %" in page
