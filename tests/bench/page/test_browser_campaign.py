"""A campaign on a running bench from plan to report by clicks; what is too slow here: `page_day`."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from bench.network.free_port import free_port
from tests.bench.page.browser_tab import open_tab
from tests.bench.page.day_at_page import (
    OPERATOR,
    VIEWER,
    change_the_club,
    page_beside,
    report_by_clicks,
    sign_in,
    sign_in_again,
    start_the_campaign,
    write_day,
)
from tests.running_bench import running_bench, write_configuration

pytestmark = [pytest.mark.live, pytest.mark.paced, pytest.mark.requires("chromium"), pytest.mark.timeout(600)]


def test_a_campaign_from_plan_to_report_outlives_its_page(browser: Any, tmp_path: Path) -> None:
    tokens, file, port = write_day(tmp_path), write_configuration(tmp_path, "day"), free_port()
    url = f"http://127.0.0.1:{port}/"
    with ExitStack() as stack, running_bench(file):
        with page_beside(file, port, tokens) as process:
            tab, viewer = (stack.enter_context(open_tab(browser, url)) for _ in range(2))
            sign_in(tab, OPERATOR)
            sign_in(viewer, VIEWER)
            start_the_campaign(tab, [viewer])
            process.kill()  # the page, not its runner
            process.wait()
        tab.text("#lost").to_contain_text("This page has lost its server")
        with page_beside(file, port, tokens):
            sign_in_again(tab, OPERATOR)
            change_the_club(tab)
            sign_in_again(viewer, VIEWER)
            report_by_clicks(tab, viewer)
