"""A day at the page of a running bench in Chromium, by clicks alone; each part's time, s.

A campaign from plan to report with a club change, while its page is killed and started again and its runner
is killed and resumed; an e-stop in mid-swing by a viewer; the page opened again; the bench killed and started
again, which loses the lease; the guided access and the air. One operator and two viewers look at once. A part
that does not go as expected raises.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bench.network.free_port import free_port
from tests.bench.page.browser_tab import PATIENCE, open_tab
from tests.bench.page.chromium import launched
from tests.bench.page.day_at_page import (
    OPERATOR,
    VIEWER,
    change_the_club,
    guided_access,
    killed_runner,
    lost_bench,
    page_beside,
    report_by_clicks,
    restarted_bench,
    sign_in,
    sign_in_again,
    start_the_campaign,
    stop_in_the_swing,
    write_day,
)
from tests.benchmarks.row import Row
from tests.running_bench import running_bench, write_configuration

_NAME = "page_day"


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Go through the day; return the time of each part. No `arguments`."""
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=PATIENCE)
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    with TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = launched(playwright, program)
        try:
            return _day(browser, Path(folder))
        finally:
            browser.close()


class _Parts:
    """Times of the parts."""

    def __init__(self) -> None:
        self.rows: list[Row] = []
        self._began = time.monotonic()

    def end(self, name: str) -> None:
        """Note the end of part `name`."""
        now = time.monotonic()
        self.rows.append(Row(_NAME, name, now - self._began, "s"))
        self._began = now


def _day(browser: Any, folder: Path) -> list[Row]:
    tokens, file, port = write_day(folder), write_configuration(folder, "day"), free_port()
    url, parts = f"http://127.0.0.1:{port}/", _Parts()
    with ExitStack() as stack, running_bench(file) as bench:
        parts.end("start of the bench")
        with page_beside(file, port, tokens) as process:
            tab, *viewers = (stack.enter_context(open_tab(browser, url)) for _ in range(3))
            sign_in(tab, OPERATOR)
            for viewer in viewers:
                sign_in(viewer, VIEWER)
            parts.end("start of the page, three tabs")
            start_the_campaign(tab, viewers)
            parts.end("plan checked, campaign started, first shot, prompt")
            process.kill()
            process.wait()
        tab.text("#lost").to_contain_text("This page has lost its server")
        with page_beside(file, port, tokens):
            sign_in_again(tab, OPERATOR)
            sign_in_again(viewers[0], VIEWER)
            parts.end("page killed and started again")
            killed_runner(tab, bench)
            parts.end("runner killed and campaign resumed")
            change_the_club(tab)
            parts.end("club changed, second shot, end")
            report_by_clicks(tab, viewers[0])
            parts.end("report written and opened")
            stop_in_the_swing(tab, viewers[0])
            parts.end("e-stop in mid-swing by a viewer")
            reopened = stack.enter_context(open_tab(browser, url))
            sign_in(reopened, OPERATOR)
            reopened.text("#state-word").to_have_text("ESTOP")
            reopened.text("#archive").to_contain_text("Two lofts")
            lost_bench(reopened, bench)
            parts.end("page opened again; bench killed")
            with running_bench(file):
                restarted_bench(reopened)
                guided_access(reopened)
                parts.end("bench started again, lease lost; access and air by forms")
    return parts.rows
