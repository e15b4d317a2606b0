"""Parts of a day at the page, by clicks alone; each begins where the one before ended."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.bench.web.browser_tab import Tab, listens, until_accepted
from tests.running_bench import BenchProcess, command_beside

OPERATOR, VIEWER = "o" * 24, "v" * 24
PLAN = """# Two lofts, one shot each.
[campaign]
name = "two-lofts"
title = "Two lofts"
[design]
compare = "club"
balls = ["tour"]
clubs = ["driver", "driver-9"]
blocks = 1
seed = 2
[warm_up]
at_most = 0
[gate]
reference = "planned"
shaft_lean_deg = 0.0
club_speed = 2.5
[analysis]
quantity = "carry_m"
carry = "reference"
expected_sd = 2.0
target_difference = 3.0
drift = "none"
[clubs.driver-9]
like = "driver"
loft_deg = 13.5
"""


@contextmanager
def page_beside(file: Path, port: int, tokens: Path) -> Iterator[subprocess.Popen[str]]:
    """Run the page until the block's end; it listens when this yields."""
    with command_beside(file, "page", "--port", str(port), "--tokens", str(tokens)) as process:
        while not listens(port):
            assert process.poll() is None, process.stderr and process.stderr.read()
            time.sleep(0.1)
        yield process


def sign_in_idle(tab: Tab, token: str) -> None:
    """Sign in with `token` on a page without a bench."""
    tab.page.fill("#token", token)
    tab.page.click("#sign-in-button")
    tab.text("#sign-in").to_be_hidden()


def sign_in(tab: Tab, token: str) -> None:
    """Sign in with `token`."""
    sign_in_idle(tab, token)
    tab.text("body").not_to_have_class("stale")


def write_day(folder: Path) -> Path:
    """Write plan and tokens into `folder`; return the file of tokens."""
    (folder / "data" / "plans").mkdir(parents=True)
    (folder / "data" / "plans" / "two-lofts.toml").write_text(PLAN)
    tokens = folder / "tokens"
    tokens.write_text(f"operator {OPERATOR}\nviewer {VIEWER}\n")
    tokens.chmod(0o600)
    return tokens


def sign_in_again(tab: Tab, token: str) -> None:
    """Sign in on a page that was started again: sessions end with the page that gave them."""
    tab.text("#sign-in").to_be_visible()
    sign_in(tab, token)


def start_the_campaign(tab: Tab, viewers: Sequence[Tab]) -> None:
    """Check the plan, start it, and continue until it requests the other club."""
    tab.page.fill("#holder", "Ann")
    tab.page.select_option("#plan", "two-lofts")
    tab.text("#plan-about").to_have_text("Two lofts, one shot each.")
    tab.text("#plan-start").to_be_disabled()
    tab.page.click("#plan-check")
    tab.text("#plan-preview").to_contain_text("Mount club")
    tab.page.check("#plan-ask")
    tab.page.click("#plan-start")
    tab.page.click("#ask-no")
    tab.text("#runner").to_be_empty()
    tab.page.click("#plan-start")
    tab.page.click("#ask-yes")
    tab.text("#runner").to_contain_text("Runner of two-lofts: running")
    for one in (tab, *viewers):
        one.text("#campaign").to_contain_text("two-lofts-")
        one.text("#lease").to_contain_text("Lease: campaign two-lofts")
    for viewer in viewers:
        viewer.text("#plan-check").to_be_disabled()
        viewer.text("#do-disarm").to_be_disabled()
    tab.text("#campaign .prompt").to_contain_text("Mount club")
    tab.text("#swing").to_contain_text("Club speed")


def killed_runner(tab: Tab, bench: BenchProcess) -> None:
    """Kill the runner while it waits for the club; resume the campaign."""
    tab.text("#campaign .prompt").to_contain_text("Mount club")
    (lock,) = bench.configuration.bench.data_dir.glob("campaigns/two-lofts-*/runner")
    os.kill(int(lock.read_text().split()[0]), signal.SIGKILL)
    tab.text("#campaign-card").to_be_hidden()
    tab.page.check("#plan-ask")
    tab.page.click("#archive button:has-text('Resume')")
    tab.page.click("#ask-yes")
    tab.text("#runner").to_contain_text("running")
    tab.text("#campaign .prompt").to_contain_text("Mount club")


def change_the_club(tab: Tab) -> None:
    """Answer the prompt; wait for the end of the campaign."""
    tab.text("#campaign .prompt").to_contain_text("Mount club")
    tab.page.click("#campaign-answer")
    tab.page.click("#ask-yes")
    tab.text("#outcome").to_contain_text("Done: Mount club")
    tab.text("#campaign-card").to_be_hidden()
    tab.text("#archive").to_contain_text("finished")


def report_by_clicks(tab: Tab, viewer: Tab) -> None:
    """Write the report; a viewer opens it."""
    tab.page.click("#archive button:has-text('Write report')")
    tab.text("#outcome").to_contain_text("written.")
    viewer.page.reload()
    viewer.text("#archive").to_contain_text("finished")
    with viewer.context.expect_page() as opened:
        viewer.page.click("#archive a:has-text('Report')")
    opened.value.wait_for_load_state()
    assert "Two lofts" in opened.value.content()


def stop_in_the_swing(tab: Tab, viewer: Tab) -> None:
    """Arm and swing; a viewer stops it."""
    tab.text("#take").to_be_enabled()
    tab.take_lease()
    if tab.page.locator("#state-word").inner_text() != "ARMED":
        until_accepted(tab, "arm")
    tab.text("#phase").to_have_text("holding the address")
    until_accepted(tab, "swing")
    viewer.page.click("#estop")
    tab.text("#state-word").to_have_text("ESTOP")
    tab.text("#events").to_contain_text("SWINGING")
    tab.text("#cause").not_to_be_empty()
    tab.page.click("#release")
    tab.text("#take").to_be_enabled()


def lost_bench(tab: Tab, bench: BenchProcess) -> None:
    """Kill the bench while this page holds its lease."""
    tab.take_lease("Ben")
    bench.process.kill()
    bench.process.wait()
    tab.text("#lost").to_contain_text("The bench is silent since")
    tab.text("#do-reset").to_be_disabled()


def restarted_bench(tab: Tab) -> None:
    """See the bench come back: without the previous lease, and stopped."""
    tab.text("#outcome").to_contain_text("The lease is lost: take it again.")
    tab.text("body").not_to_have_class("stale")
    tab.text("#state-word").to_have_text("ESTOP")
    tab.take_lease("Ben")
    tab.do("reset", ask=False)


def guided_access(tab: Tab) -> None:
    """Open and end the access by its steps, then enter the air."""
    tab.text("#state-word").to_have_text("SAFE")
    tab.text("#step-access").to_be_visible()
    tab.page.click("#step-access")
    tab.page.click("#ask-yes")
    tab.text("#state-word").to_have_text("ACCESS")
    tab.page.click("#step-secure")
    tab.page.click("#ask-yes")
    tab.text("#state-word").not_to_have_text("ACCESS")
    tab.page.click("summary:has-text('Air at the bench')")
    for name, value in (("temperature", "21,5"), ("pressure", "1013"), ("humidity", "45")):
        tab.page.fill(f"#form-air-{name}", value)
    tab.page.click("#form-air-enter")
    tab.text("#values").to_contain_text("21.5 °C, 1013.0 hPa, 45 %")
