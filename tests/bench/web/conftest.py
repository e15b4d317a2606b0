"""A bench without a robot that publishes its state as the daemon does, and its page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bench.config import Configuration
from tests.bench.fake_bench_service import (
    FakeDesk,
    RunningPlane,
    loopback_configuration,
    publishing,
    running_plane,
)
from tests.bench.web.browser_tab import TIMEOUT
from tests.bench.web.chromium import launched
from tests.bench.web.noting_program import NotingProgram
from tests.bench.web.running_page import RunningPage, running_page


@contextmanager
def followed_page(configuration: Configuration, **arguments: Any) -> Iterator[RunningPage]:
    """Run a bench that publishes its state, and its page with `arguments`; yield the page once it has it."""
    with (
        running_plane(FakeDesk(), configuration) as running,
        publishing(running),
        running_page(configuration, **arguments) as page,
    ):
        with page.stream() as following:
            following("state")
        yield page


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
