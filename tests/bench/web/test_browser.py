"""The page in a real browser, as seen and clicked by an operator."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from bench.base.address import free_port
from bench.base.lifecycle import Request, State
from bench.config import Configuration
from bench.network.lease import MIN_SECONDS
from bench.web import _page_service
from bench.web.page_access import PageAddress
from tests.bench.fake_bench_service import FakeDesk, loopback_configuration, publishing, running_plane
from tests.bench.web.browser_tab import open_tab
from tests.bench.web.day_at_page import VIEWER, sign_in
from tests.bench.web.running_page import RunningPage, running_page

pytestmark = [pytest.mark.live, pytest.mark.requires("chromium"), pytest.mark.timeout(400)]

RECORDS = Path(__file__).parents[2] / "replay"
SCRIPT = "<img src=x onerror=alert(1)>"

CONTRAST = """() => {
  const rgb = (text) => text.match(/[0-9.]+/g).map(Number);
  const linear = (v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  const light = (colour) => {
    const [r, g, b] = colour.slice(0, 3).map((v) => linear(v / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (element) => {
    for (let at = element; at; at = at.parentElement) {
      const colour = rgb(getComputedStyle(at).backgroundColor);
      if (colour.length < 4 || colour[3] > 0.99) return colour;
    }
    return [255, 255, 255];
  };
  const poor = [];
  for (const e of document.body.querySelectorAll("*")) {
    const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    if (!own || !e.checkVisibility() || e.closest("svg")) continue;
    const [a, b] = [light(rgb(getComputedStyle(e).color)), light(behind(e))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < 4.5) poor.push(`${e.tagName} ${e.id} ${e.textContent.slice(0, 30)} ${ratio.toFixed(2)}`);
  }
  return poor;
}"""
"""Texts whose contrast is below that of WCAG AA."""
UNNAMED = """() => [...document.querySelectorAll("button, input, select")]
  .filter((e) => e.checkVisibility() && !e.textContent.trim() && !e.labels?.length && !e.ariaLabel)
  .map((e) => e.id)"""
BOTTOMS = """() => [...document.querySelectorAll("#state, #swing .big, #swing figure:nth-child(-n+3)")]
  .map((e) => e.getBoundingClientRect().bottom)"""
"""Lower edges of state, figures, and the curves of head speed, tracking and pressures."""
SIZES = """() => [document.documentElement.scrollWidth,
  document.getElementById("stop").getBoundingClientRect().height]"""


@pytest.fixture
def service() -> FakeDesk:
    return FakeDesk()


@pytest.fixture
def silence() -> list[Callable[[], None]]:
    return []


@pytest.fixture
def page(service: FakeDesk, silence: list[Callable[[], None]]) -> Iterator[RunningPage]:
    with ExitStack() as stack:
        running = stack.enter_context(running_plane(service, loopback_configuration()))
        speaking = stack.enter_context(publishing(running))
        silence.append(speaking.clear)
        yield stack.enter_context(running_page(running.configuration))


def test_page_lease_holder_commands_and_any_tab_stops(
    browser: Any, page: RunningPage, service: FakeDesk
) -> None:
    with open_tab(browser, page.url) as tab, open_tab(browser, page.url) as other:
        tab.text("#state-word").to_have_text("ESTOP")
        tab.text("#action").to_have_text("Reset to begin.")
        tab.take_lease(SCRIPT)
        other.text("#lease").to_contain_text(f"Lease: {SCRIPT}")
        tab.do("reset", ask=False)
        tab.text("#state-word").to_have_text("SAFE")
        tab.text("#do-home").to_be_enabled()
        tab.page.click("#do-home")
        tab.page.click("#ask-no")
        assert Request.HOME not in service.requests
        tab.do("home")
        tab.text("#state-word").to_have_text("READY")
        other.text("#state-word").to_have_text("READY")
        other.text("#do-arm").to_be_disabled()  # the lease is another tab's
        tab.text("#do-swing").to_be_disabled()
        tab.text("#do-arm").to_be_enabled()
        tab.page.click("#do-arm")
        tab.text("#ask").to_be_visible()
        tab.page.click("#stop")  # a question covers no stop; what it asked is gone
        tab.text("#ask").to_be_hidden()
        assert [what for what, _ in service.stops] == ["stop"]
        assert Request.ARM not in service.requests
        other.page.click("#stop")  # by anybody
        other.text("#outcome").to_contain_text("Stop: the bench has taken it.")
        assert [what for what, _ in service.stops] == ["stop", "stop"]
        tab.page.click("#release")
        tab.text("#lease").to_have_text("Lease: not held")


def test_page_silent_bench_is_shown_as_stale(
    browser: Any, page: RunningPage, silence: list[Callable[[], None]]
) -> None:
    with open_tab(browser, page.url) as tab:
        tab.text("body").not_to_have_class("stale")
        silence[0]()
        began = time.monotonic()
        tab.text("body").to_have_class("stale")
        took = time.monotonic() - began
        tab.text("#lost").to_contain_text("The bench is silent since")
        tab.text("#do-reset").to_be_disabled()
        tab.text("#stop").to_be_enabled()
        assert took < 10.0, f"{took:.1f} s"  # 2 s by its own clock; a busy browser paints late


def test_page_stop_without_bench_advises_emergency_stop(browser: Any, configuration: Configuration) -> None:
    with running_page(configuration) as page, open_tab(browser, page.url) as tab:
        tab.page.click("#stop")
        tab.text("#outcome").to_contain_text("Use the emergency stop")


def test_page_late_answer_from_before_sign_in_is_ignored(
    browser: Any, service: FakeDesk, tmp_path: Path
) -> None:
    tokens = tmp_path / "tokens"
    tokens.write_text(f"viewer {VIEWER}\n")
    tokens.chmod(0o600)
    late: list[tuple[Any, Any]] = []
    with ExitStack() as stack:
        running = stack.enter_context(running_plane(service, loopback_configuration()))
        stack.enter_context(publishing(running))
        address = PageAddress(port=free_port(), tokens=tokens)
        page = stack.enter_context(running_page(running.configuration, address))
        tab = stack.enter_context(open_tab(browser, page.url))
        tab.text("#sign-in").to_be_visible()

        def hold(route: Any) -> None:  # the page asks every 2 s
            late.append((route, route.fetch()))

        tab.page.route("**/api/you", hold, times=1)
        while not late:
            tab.page.wait_for_timeout(50.0)
        sign_in(tab, VIEWER)
        for route, answer in late:
            route.fulfill(response=answer)
        tab.page.wait_for_timeout(500.0)
        tab.text("#sign-in").to_be_hidden()


def test_page_lost_lease_is_shown_and_not_retaken(
    browser: Any, page: RunningPage, service: FakeDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_page_service, "LEASE", MIN_SECONDS)
    with open_tab(browser, page.url) as tab:
        tab.take_lease()
        tab.page.route("**/api/lease", lambda route: route.abort())  # the tablet is out of reach
        tab.text("#lease").to_have_text("Lease: not held")
        tab.page.unroute("**/api/lease")
        tab.text("#outcome").to_contain_text("The lease is lost: take it again.")
        tab.text("#take").to_be_enabled()
        tab.text("#do-reset").to_be_disabled()
    assert service.requests == []


def test_page_is_readable_in_both_themes_on_phone(browser: Any, page: RunningPage) -> None:
    phone: dict[str, Any] = {"viewport": {"width": 360, "height": 740}, "bypass_csp": True}
    for theme in ("light", "dark"):
        with open_tab(browser, page.url, color_scheme=theme, **phone) as tab:
            tab.text("body").not_to_have_class("stale")
            tab.text("#state-word").to_have_text("ESTOP")
            assert tab.page.evaluate(CONTRAST) == []
            width, height = tab.page.evaluate(SIZES)
            assert width <= 360
            assert height >= 48
            assert tab.page.evaluate(UNNAMED) == []
            tab.page.keyboard.press("Tab")
            assert tab.page.evaluate("() => document.activeElement.id") == "stop"


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (768, 1024)])
def test_page_first_screen_has_state_stop_last_swing_and_curves(
    browser: Any, configuration: Configuration, width: int, height: int
) -> None:
    records = configuration.bench.data_dir / "swings" / configuration.bench.id
    records.mkdir(parents=True)
    (records / "20260101T000000000000Z-7.parquet").write_bytes((RECORDS / "swing.parquet").read_bytes())
    with running_plane(FakeDesk(State.ARMED), configuration) as running, publishing(running):
        with running_page(configuration) as page:
            with open_tab(browser, page.url, viewport={"width": width, "height": height}) as tab:
                tab.text("#swing .plots figure").to_have_count(4)
                tab.text("#state-word").to_have_text("ARMED")
                tab.text("#warnings li").to_have_count(2)
                bottoms = tab.page.evaluate(BOTTOMS)
                stop = tab.page.evaluate("document.querySelector('.stopbar').getBoundingClientRect().top")
                assert max(bottoms) <= stop < height
                assert tab.page.evaluate(SIZES)[0] <= width
