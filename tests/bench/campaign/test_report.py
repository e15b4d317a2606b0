from __future__ import annotations

import html.parser
import json
import os
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.campaign.report import Setup, render_report, write_report
from bench.campaign.report_plots import all_figures
from bench.errors import BenchError
from bench.shot.shot import Status
from bench.shot.shot_record import ShotRecord
from bench.telemetry.cycle_record import CYCLE
from sim.plant import Site
from sim.robot import RobotParameters

Records = Callable[[int], list[ShotRecord]]


@pytest.fixture(scope="module")
def setup(robot: RobotParameters) -> Setup:
    return Setup(
        "Two balls",
        robot,
        Site(ball_x=0.2315, ball_y=-1.514, ground=-1.57),
        facts={"Seed": "7", "Air": "25 °C"},
        versions={"numpy": "2.4"},
        configuration={"loop": {"rate_hz": 1000}, "plant": {"shoulder": {"stop": {"energy": 60.0}}}},
        assumptions=("Friction is assumed.",),
    )


@pytest.fixture(scope="module")
def text(robot: RobotParameters, make_records: Records, setup: Setup) -> str:
    """The report of ten shots, rendered once: the pictures take a second or two."""
    return render_report(make_records(10), setup)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of the words."""
    monkeypatch.setattr("bench.campaign.report.all_figures", lambda *_: {"dispersion": "", "head": ""})


class Page(html.parser.HTMLParser):
    """Collects ids, tags left open and every address that a browser would load."""

    VOID = frozenset({"meta", "link", "br", "img", "hr", "use"})

    def __init__(self) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.open: list[str] = []
        self.loads: list[str] = []
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href", "xlink:href", "srcset", "data"):
                self.loads.append(value or "")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data.split()


def _page(text: str) -> Page:
    page = Page()
    page.feed(text)
    return page


def test_the_page_is_well_formed_and_loads_nothing(text: str) -> None:
    page = _page(text)
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    assert [address for address in page.loads if not address.startswith("#")] == ["data:,"]
    assert {address[1:] for address in page.loads if address.startswith("#")} <= set(page.ids)


def test_every_picture_has_words(text: str) -> None:
    assert text.count("<svg") == text.count('role="img" aria-label=') == 5
    assert text.count("<svg aria-hidden") == 5


def test_the_same_input_gives_the_same_file(
    tmp_path: Path, text: str, make_records: Records, setup: Setup
) -> None:
    write_report(tmp_path / "report.html", make_records(10), setup)
    assert (tmp_path / "report.html").read_text() == text
    assert os.listdir(tmp_path) == ["report.html"]


def test_the_verdict_comes_first_and_the_counts_are_right(text: str) -> None:
    words = " ".join(_page(text).words)
    assert words.index("Pro V has") < words.index("Summary by ball") < words.index("All shots")
    assert "10 shots: 8 valid, 1 excluded, 1 not hit" in words
    assert "Pro V 5 4 1" in words
    assert "Range 4 4 0" in words
    assert "excluded: club speed 0.6 m/s off the plan" in words
    assert "failed: no ball seen on the tee" in words
    assert "over 8 valid shots" in words
    for word in ("energy", "rate_hz", "Friction is assumed", "25 °C", "encoders+model", "simulated"):
        assert word in words


@pytest.mark.usefixtures("no_pictures")
def test_excluded_shots_change_no_statistics(make_records: Records, setup: Setup) -> None:
    records = make_records(10)
    odd = [
        replace(r, shot=replace(r.shot, carry_m=1.0)) if r.shot.status is Status.EXCLUDED else r
        for r in records
    ]

    def result(text: str) -> str:
        return text[text.index('id="result"') : text.index('id="robot"')]

    assert result(render_report(odd, setup)) == result(render_report(records, setup))


def test_names_from_outside_cannot_break_the_page(make_records: Records, setup: Setup) -> None:
    evil = '<script>alert("$x$")</script>--><b>'
    records = [_changed(r, ball=evil, club=evil) for r in make_records(3)]
    text = render_report(records, replace(setup, title=evil, facts={evil: evil}))
    assert "<script" not in text
    assert _page(text).open == []


def _changed(record: ShotRecord, **values: Any) -> ShotRecord:
    return replace(record, shot=replace(record.shot, **values))


def test_a_series_that_never_hit_a_ball_still_has_a_report(make_records: Records, setup: Setup) -> None:
    nothing = {"status": Status.FAILED, "reason": "stopped", "carry_m": None}
    records = [ShotRecord(_changed(r, **nothing).shot, np.zeros(0, CYCLE)) for r in make_records(2)]
    words = " ".join(_page(render_report(records, setup)).words)
    assert "Too few valid shots" in words or "nothing to compare" in words
    assert "repeatability is not known" in words


def test_one_shot_is_enough_for_pictures(make_records: Records, setup: Setup) -> None:
    assert "nothing to compare" in render_report(make_records(1), setup)


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("shots", [2, 3])
def test_few_shots_are_no_problem(make_records: Records, setup: Setup, shots: int) -> None:
    assert "Too few valid shots" in render_report(make_records(shots), setup)


@pytest.mark.usefixtures("no_pictures")
def test_alike_shots_are_called_alike(make_records: Records, setup: Setup) -> None:
    pair = make_records(2)
    alike = [_changed(pair[n % 2], shot=n + 1) for n in range(6)]
    assert "without scatter" in render_report(alike, setup)


def test_hardware_records_have_no_plant_figures(make_records: Records, setup: Setup) -> None:
    records = make_records(2)
    for name in ("plant_angle", "plant_velocity", "plant_pressure", "plant_effort", "plant_head_position"):
        records[0].cycles[name] = np.nan
    figures = all_figures(records, records[0], setup.robot, setup.site, 0.0213)
    assert "not measured on hardware" in figures["valves"]


def test_no_shots_are_no_report(setup: Setup) -> None:
    with pytest.raises(ValueError, match="at least one shot"):
        render_report([], setup)


@pytest.mark.usefixtures("no_pictures")
def test_a_folder_that_is_not_there_is_told(tmp_path: Path, make_records: Records, setup: Setup) -> None:
    with pytest.raises(BenchError, match="nothing was stored"):
        write_report(tmp_path / "absent" / "report.html", make_records(1), setup)


@pytest.mark.requires("chromium")
@pytest.mark.timeout(180)
def test_a_browser_shows_and_prints_it_without_network(
    tmp_path: Path, text: str, tool: Callable[[str], str]
) -> None:
    (page := tmp_path / "report.html").write_text(text)
    pdf = tmp_path / "report.pdf"
    console, requests = _browse(tool("chromium"), page, tmp_path, f"--print-to-pdf={pdf}")
    assert console == []
    assert requests == []
    content = pdf.read_bytes()
    assert content.startswith(b"%PDF")
    assert 4 <= len(re.findall(rb"/Type\s*/Page\b", content)) <= 8


@pytest.mark.requires("chromium")
@pytest.mark.timeout(180)
def test_the_browser_would_have_told(tmp_path: Path, tool: Callable[[str], str]) -> None:
    """The test above sees what it looks for."""
    (page := tmp_path / "page.html").write_text(
        '<img src="http://127.0.0.1:9/x.png"><script>console.error("seen")</script>'
    )
    console, requests = _browse(tool("chromium"), page, tmp_path, "--dump-dom")
    assert any("seen" in line for line in console)
    assert requests == ["http://127.0.0.1:9/x.png"]


def _browse(chromium: str, page: Path, folder: Path, action: str) -> tuple[list[str], list[str]]:
    """Open `page` in a browser of its own; return what its console says and the addresses it asks for."""
    log = folder / "net.json"
    done = subprocess.run(
        [
            chromium,
            *"--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync".split(),
            *"--disable-background-networking --disable-component-update --disable-dev-shm-usage".split(),
            *"--enable-logging=stderr --no-pdf-header-footer".split(),
            f"--user-data-dir={folder / 'profile'}",
            f"--log-net-log={log}",
            action,
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    events: dict[str, Any] = json.loads(log.read_text())
    asked = [event["params"] for event in events["events"] if "url" in event.get("params", {})]
    # The browser asks on its own behalf too; what the page asks for has the page as its initiator.
    pages = {p["url"] for p in asked if p.get("initiator", "not an origin") != "not an origin"}
    return console, sorted(url for url in pages if not url.startswith(("file:", "data:")))
