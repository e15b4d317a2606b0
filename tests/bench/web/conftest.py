"""A bench without a robot that publishes its state as the daemon does, and its page."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bench.config import Configuration
from tests.bench.fake_bench_service import FakeDesk, RunningPlane, loopback_configuration, running_plane
from tests.bench.web.browser_tab import TIMEOUT
from tests.bench.web.chromium import launched
from tests.bench.web.noting_program import NotingProgram
from tests.bench.web.running_page import RunningPage, running_page


@contextmanager
def publishing(running: RunningPlane) -> Iterator[threading.Event]:
    """Publish the state until the block's end; while the yielded event is clear, stay silent."""
    ended, speaking = threading.Event(), threading.Event()
    speaking.set()

    def publish() -> None:
        while not ended.wait(0.02):
            if speaking.is_set():
                running.plane.publish_state(running.service.status())

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield speaking
    finally:
        ended.set()
        thread.join()


@pytest.fixture(scope="module")
def running() -> Iterator[RunningPlane]:
    with running_plane(FakeDesk(), loopback_configuration()) as running, publishing(running):
        yield running


@pytest.fixture(scope="module")
def page(running: RunningPlane) -> Iterator[RunningPage]:
    with running_page(running.configuration) as page:
        with page.stream() as following:
            following("state")  # it is connected
        yield page


@pytest.fixture
def program(tmp_path: Path) -> Iterator[NotingProgram]:
    """Return a program in place of `golfbench` that notes its arguments; it ends with the test."""
    found = NotingProgram(tmp_path)
    yield found
    found.note("end")


@pytest.fixture
def configuration(tmp_path: Path) -> Configuration:
    """Return a bench's configuration whose data are the test's own."""
    given = loopback_configuration()
    return replace(given, bench=replace(given.bench, data_dir=tmp_path / "data"))


@pytest.fixture
def browser(tool: Callable[[str], str]) -> Iterator[Any]:
    """Start the system's Chromium; it ends with the test, and all its processes with it."""
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=TIMEOUT)
    with sync_playwright() as playwright:
        browser = launched(playwright, tool("chromium"))
        yield browser
        browser.close()
