"""A day at the page of a running bench, by clicks alone: one operator and two viewers look at once.

A campaign from plan to report with a club change, while its page is killed and started again and its runner
is killed and resumed; an e-stop in mid-swing by a viewer; the page opened again; the bench killed and started
again, which loses the lease; the guided access and the air.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from bench.base.address import free_port
from tests.bench.web.browser_tab import open_tab
from tests.bench.web.day_at_page import (
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
from tests.running_bench import running_bench, write_configuration

pytestmark = [
    pytest.mark.live,
    pytest.mark.paced,
    pytest.mark.requires("chromium"),
    pytest.mark.timeout(1200),
]


def test_page_full_day_completes_campaign_and_recovers(browser: Any, tmp_path: Path) -> None:
    tokens, file, port = write_day(tmp_path), write_configuration(tmp_path, "day"), free_port()
    url = f"http://127.0.0.1:{port}/"
    with ExitStack() as stack, running_bench(file) as bench:
        with page_beside(file, port, tokens) as process:
            tab, *viewers = (stack.enter_context(open_tab(browser, url)) for _ in range(3))
            sign_in(tab, OPERATOR)
            for viewer in viewers:
                sign_in(viewer, VIEWER)
            start_the_campaign(tab, viewers)
            process.kill()  # the page, not its runner
            process.wait()
        tab.text("#lost").to_contain_text("This page has lost its server")
        with page_beside(file, port, tokens):
            sign_in_again(tab, OPERATOR)
            sign_in_again(viewers[0], VIEWER)
            killed_runner(tab, bench)
            change_the_club(tab)
            report_by_clicks(tab, viewers[0])
            stop_in_the_swing(tab, viewers[0])
            reopened = stack.enter_context(open_tab(browser, url))
            sign_in(reopened, OPERATOR)
            reopened.text("#state-word").to_have_text("ESTOP")
            reopened.text("#archive").to_contain_text("Two lofts")
            lost_bench(reopened, bench)
            with running_bench(file):
                restarted_bench(reopened)
                guided_access(reopened)
