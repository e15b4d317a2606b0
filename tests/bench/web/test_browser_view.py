"""Rerun's web viewer of a running bench, one click away from its page, from this machine alone."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from bench.base.address import free_port
from tests.bench.web.browser_tab import listens, open_tab
from tests.running_bench import command_beside, running_bench, write_configuration

pytestmark = [pytest.mark.live, pytest.mark.paced, pytest.mark.requires("chromium"), pytest.mark.timeout(900)]

OPENS = 300_000.0
"""ms for the viewer to start: it compiles."""


def test_page_viewer_opens_in_new_tab_and_closes(browser: Any, tmp_path: Path) -> None:
    file, port = write_configuration(tmp_path, "view"), free_port()
    with running_bench(file), command_beside(file, "page", "--port", str(port)) as process:
        while not listens(port):
            assert process.poll() is None
            time.sleep(0.2)
        with open_tab(browser, f"http://127.0.0.1:{port}/") as tab:
            tab.text("body").not_to_have_class("stale")
            answered, deadline = list[str](), time.monotonic() + OPENS / 1e3
            tab.context.on("requestfinished", lambda asked: answered.append(asked.url))
            with tab.context.expect_page(timeout=OPENS) as opened:
                tab.page.click("#viewer a")
            tab.text("#outcome").to_contain_text("opens in a new tab")
            view = opened.value
            view.wait_for_url("**/?url=rerun*", timeout=OPENS)
            while not any(".wasm" in url for url in answered):  # the whole viewer, of this machine
                assert time.monotonic() < deadline
                view.wait_for_timeout(200)
            assert [
                url for url in answered if not url.startswith(("http://127.0.0.1:", "blob:", "data:"))
            ] == []
            tab.page.click("#viewer-close")
            tab.text("#viewer-close").to_be_hidden()
        process.terminate()
        assert process.wait(60) == 0
