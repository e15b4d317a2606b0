"""A commissioning by clicks: a wrong machine is identified, repaired, and measured to its report."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from bench.base.address import free_port
from bench.commissioning.commissioning import STEPS, commissioning_process, read_state
from tests.bench.web.browser_tab import open_tab
from tests.bench.web.day_at_page import OPERATOR, VIEWER, page_beside, sign_in_idle, write_day
from tests.running_bench import write_configuration

pytestmark = [
    pytest.mark.live,
    pytest.mark.paced,
    pytest.mark.requires("chromium"),
    pytest.mark.timeout(3000),
]

STEP = 600_000.0
"""ms for a step: half a minute of computation, on busy processors much longer."""
WRONG = '[faults.vents]\nsignal = "vents"\nkind = "stuck"\nvalue = 1.0\n'


def resume(tab: Any, repaired: str) -> None:
    tab.page.fill("#commissionings input", repaired)
    tab.page.click("#commissionings button:has-text('Resume')")


@pytest.mark.release
def test_commissioning_page_faulty_machine_is_repaired_and_measured(browser: Any, tmp_path: Path) -> None:
    tokens, file, port = write_day(tmp_path), write_configuration(tmp_path, "first"), free_port()
    robots = tmp_path / "data" / "robots"
    robots.mkdir()
    (robots / "shut-vents.toml").write_text(f'base = "{file}"\n{WRONG}')
    url = f"http://127.0.0.1:{port}/"
    with page_beside(file, port, tokens), open_tab(browser, url) as tab, open_tab(browser, url) as viewer:
        sign_in_idle(tab, OPERATOR)
        sign_in_idle(viewer, VIEWER)
        tab.text("#commission-card").to_contain_text("A running bench cannot be commissioned yet.")
        tab.text("#commission-start").to_be_disabled()
        tab.page.select_option("#robot-file", "shut-vents")
        tab.page.click("#commission-check")
        tab.text("#commission-preview").to_contain_text(STEPS[0].bounds_text)
        tab.page.click("#commission-start")
        for one in (tab, viewer):
            one.text("#commissionings .prompt").to_contain_text("Machine fault: vents", timeout=STEP)
            one.text("#commissionings .prompt").to_contain_text("The vents stay shut")
        viewer.text("#commissionings button:has-text('Resume')").to_be_disabled()
        (folder,) = (path.parent for path in tmp_path.glob("data/commissioning/*/commissioning.json"))
        assert read_state(folder).done == []

        tab.page.select_option("#commissionings select", "")  # the vents are repaired
        resume(tab, "vents")
        tab.text("#commissionings").to_contain_text("running, 1 of 8 steps done", timeout=STEP)
        process = commissioning_process(folder)
        assert process is not None
        os.kill(process, signal.SIGKILL)  # a crash costs one step
        tab.text("#commissionings").to_contain_text("not running, 1 of 8 steps done")
        tab.text("#commission-ended").to_contain_text("exit code -9")
        resume(tab, "nothing")
        tab.text("#commissionings").to_contain_text("running, 2 of 8 steps done", timeout=STEP)
        tab.page.click("#commissionings button:has-text('Stop')")
        tab.text("#commissionings").to_contain_text("not running, 2 of 8 steps done")
        tab.text("#commission-ended").to_be_empty()
        resume(tab, "nothing")
        tab.text("#commissionings").to_contain_text("running, 5 of 8 steps done", timeout=3 * STEP)
        tab.page.click("#commissionings button:has-text('Stop')")  # its swings are computed for minutes
        tab.text("#commissionings").to_contain_text("not running, 5 of 8 steps done")
        with viewer.context.expect_page() as opened:
            viewer.page.click("#commissionings a:has-text('Report so far')")
        opened.value.wait_for_load_state()
        assert "Left: Swings of 40, 60, 80 and 100 %" in opened.value.content()
        assert "Signature" in opened.value.content()
        with viewer.page.expect_download() as download:
            viewer.page.click("#commissionings a:has-text('robot.toml')")
        assert "Commissioned on" in download.value.path().read_text()
