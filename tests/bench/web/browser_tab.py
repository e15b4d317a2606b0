"""A page in a real browser, and what went wrong in it."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

TIMEOUT = 120_000.0
"""ms for an element to become as expected: processors may be busy."""


class Tab:
    """One open page, and what went wrong in it."""

    def __init__(self, browser: Any, url: str, **options: Any) -> None:
        self.context = browser.new_context(**options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(TIMEOUT)
        self.faults: list[str] = []
        self.foreign: list[str] = []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("console", self._hear)
        self.page.on("request", lambda asked: self._note(asked.url, url))
        self.page.goto(url)

    def _hear(self, message: Any) -> None:
        # A refusal is an answer, too: the browser logs it.
        if message.type == "error" and not message.text.startswith("Failed to load resource"):
            self.faults.append(message.text)

    def _note(self, asked: str, own: str) -> None:
        if not asked.startswith(own):
            self.foreign.append(asked)

    def text(self, location: str) -> Any:
        from playwright.sync_api import expect

        return expect(self.page.locator(location))

    def do(self, name: str, ask: bool = True) -> None:
        self.text(f"#do-{name}").to_be_enabled()
        self.page.click(f"#do-{name}")
        if ask:
            self.page.click("#ask-yes")
        self.text("#outcome").to_contain_text("accepted")

    def take_lease(self, name: str = "Ann") -> None:
        self.text("#take").to_be_enabled()
        self.page.fill("#holder", name)
        self.page.click("#take")
        self.text("#release").to_be_visible()
        self.text("#lease").to_contain_text(name)  # the bench's state, which comes after the answer


@contextmanager
def open_tab(browser: Any, url: str, **options: Any) -> Iterator[Tab]:
    tab = Tab(browser, url, **options)
    try:
        yield tab
    finally:
        tab.context.close()
    assert tab.faults == []
    assert tab.foreign == []


def listens(port: int) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
        return True
    return False


def until_accepted(tab: Tab, name: str) -> None:
    """Click until the bench takes it: it refuses while it vents or fills, and the page repeats nothing."""
    said = ""
    for _ in range(30):
        tab.text(f"#do-{name}").to_be_enabled()
        tab.page.click(f"#do-{name}")
        tab.page.click("#ask-yes")
        tab.text("#outcome").not_to_contain_text("sent")
        said = tab.page.locator("#outcome").inner_text()
        if "accepted" in said:
            return
        assert "wait" in said.lower(), said
        time.sleep(0.5)
    raise AssertionError(said)
