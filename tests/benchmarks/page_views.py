"""The page beside a running bench: weight, first figure, age of a state, the loop with ten pages open.

Readers are HTTP clients of this process that read what a browser reads, or with `--browsers` tabs of
Chromium, which also tell when they have painted a state; the loop's timing is taken in turns without and with
them: a busy machine disturbs both alike. Its histograms are printed beside each other.
"""

from __future__ import annotations

import argparse
import http.client
import json
import re
import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from bench.errors import Refused
from bench.lifecycle import State
from bench.network.free_port import free_port
from bench.page.static_files import static_files
from bench.processes.plan import TIMING_FILE
from bench.processes.tick_timing import BUCKETS, SEGMENTS, TimingReader, summary, upper_edges
from tests.bench.page.chromium import launched
from tests.benchmarks.row import Row
from tests.running_bench import BenchProcess, command_beside, running_bench, write_configuration

_START = 300.0
"""s in which the page starts."""
_NAME = "page_views"
_ATTEMPTS = 3


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Look for `--seconds` a turn; return weight, first figure, ages, and the loop's timing side by side."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks page_views")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--pages", type=int, default=10)
    parser.add_argument("--browsers", action="store_true", help="tabs of Chromium instead of HTTP clients")
    parser.add_argument("--swings", type=int, default=3)
    parser.add_argument("--time", choices=("wall", "paced"), default="wall", help="clock of the bench")
    options = parser.parse_args(arguments)
    port = free_port()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        file = write_configuration(folder, "views")
        bench = stack.enter_context(running_bench(file, clock=options.time))
        stack.enter_context(command_beside(file, "page", "--port", str(port)))
        wait_for_page(port)
        ended = _swing_ages(bench, port, options.swings)
        first = [_first_figure(port) for _ in range(10)]
        alone, beside = [], []
        counts = {name: np.zeros((2, BUCKETS), np.int64) for name in _SHOWN}
        ages: list[tuple[float, float]] = []
        painted = _Painted([], [])
        for _ in range(options.turns):
            known, shown, behind = len(ages), len(painted.updates), _behind(bench)
            alone.append(_timing(bench, options.seconds, counts, 0))
            with ExitStack() as open_pages:
                if options.browsers:
                    open_pages.enter_context(_browsers(port, options.pages, painted))
                    open_pages.enter_context(_readers(port, 1, ages))
                else:
                    open_pages.enter_context(_readers(port, options.pages, ages))
                beside.append(_timing(bench, options.seconds, counts, 1))
            ages[known:] = [(total - behind, own) for total, own in ages[known:]]
            painted.updates[shown:] = [age - 1e3 * behind for age in painted.updates[shown:]]
    weight = sum(len(one.content) for one in static_files().values())
    total, own = (1e3 * np.array(column) for column in zip(*ages, strict=True))
    rows = [
        Row(_NAME, "weight of the page, all files", weight / 1e3, "kB", at_most=300.0),
        Row(
            _NAME,
            "first figure after the connection, median",
            1e3 * float(np.median(first)),
            "ms",
            at_most=1e3,
        ),
        Row(_NAME, "age of a state at a reader, p50", float(np.median(total)), "ms", "from its tick"),
        Row(_NAME, "age of a state at a reader, p95", float(np.percentile(total, 95)), "ms", "from its tick"),
        Row(_NAME, "of it in the page, p95", float(np.percentile(own, 95)), "ms", at_most=200.0),
    ]
    for name, values in ended.items():
        rows.append(
            Row(_NAME, f"swing shown after its end, {name}", float(np.median(values)), "ms", _turns(values))
        )
    if painted.first:
        note = "from the navigation to the state in the document, a new tab each"
        first_figure = float(np.median(painted.first))
        rows.append(Row(_NAME, "first figure in Chromium, median", first_figure, "ms", note, at_most=1e3))
        note = f"from its tick, {len(painted.updates)} states"
        for share, bound in ((50, None), (95, 200.0), (99, None)):
            age = float(np.percentile(painted.updates, share))
            rows.append(Row(_NAME, f"age of a painted state, p{share}", age, "ms", note, at_most=bound))
    _print_histograms(counts, options.pages)
    for key in alone[0]:
        unit = "" if "ticks" in key else "µs"
        for name, turns in (("no page", alone), (f"{options.pages} pages", beside)):
            values = [float(turn[key]) for turn in turns]
            rows.append(Row(_NAME, f"loop {key}, {name}", float(np.median(values)), unit, _turns(values)))
    return rows


def _turns(values: Sequence[float]) -> str:
    return "turns: " + ", ".join(f"{value:.0f}" for value in values)


def _swing_ages(bench: BenchProcess, port: int, swings: int) -> dict[str, list[float]]:
    """Return the times from the ends of swings to their figures on the page: at first, and as stored, ms."""
    found: dict[str, list[float]] = {"from the ring": [], "from its record": []}
    over = threading.Event()
    arrived: list[tuple[float, bool]] = []

    def read() -> None:
        for at, view in messages(port, "swing"):
            arrived.append((at, view["stored"]))
            if over.is_set():
                return

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    with bench.client.lease("page_views"):
        for _ in range(_ATTEMPTS * swings):
            if len(found["from its record"]) == swings:
                break
            with suppress(Refused, TimeoutError):  # a stall of the machine stops a robot on its own clock
                bench.recover()
                bench.take_address()
                arrived.clear()
                bench.swing()
                bench.wait_until(lambda record: record["state"] == State.SWINGING)
                end = float(bench.wait_until(lambda record: record["state"] != State.SWINGING)["time"])
                end += _behind(bench)
                deadline = time.monotonic() + 30.0
                while {stored for _, stored in arrived} != {True, False} and time.monotonic() < deadline:
                    time.sleep(0.01)
                for name, stored in (("from the ring", False), ("from its record", True)):
                    found[name] += [1e3 * (at - end) for at, kind in arrived if kind is stored][:1]
    over.set()
    return {name: values for name, values in found.items() if values}


def _behind(bench: BenchProcess) -> float:
    """Return by how much the loop's time is behind CLOCK_MONOTONIC, s, to the quickest look at its ring.

    Zero on the wall's clock. A paced loop counts ticks: each one that it skips puts it a period further back.
    """
    found = []
    for _ in range(200):
        record = bench.cycles.newest()
        if record is not None:
            found.append(time.monotonic() - float(record["time"][0]))
        time.sleep(0.0017)
    return min(found)


class _Painted(NamedTuple):
    """What tabs of Chromium have told, ms."""

    first: list[float]
    """From the navigation to the first state in the document."""
    updates: list[float]
    """From a tick to its state on the screen."""


@contextmanager
def _browsers(port: int, number: int, painted: _Painted) -> Iterator[None]:
    """Keep `number` tabs of Chromium open; add what they tell."""
    from playwright.sync_api import sync_playwright

    program = shutil.which("chromium") or shutil.which("chromium-browser")
    with sync_playwright() as playwright:
        browser = launched(playwright, program)
        pages = []
        for _ in range(number):
            page = browser.new_context().new_page()
            page.set_default_timeout(_START * 1e3)
            page.add_init_script(_FIRST_FIGURE)
            page.add_init_script(_UPDATES)
            page.goto(f"http://127.0.0.1:{port}/")
            page.wait_for_function("() => window.firstFigure !== undefined", timeout=_START * 1e3)
            painted.first.append(float(page.evaluate("() => window.firstFigure")))
            pages.append(page)
        for page in pages:
            page.evaluate("() => { window.updates.length = 0; }")  # they waited for the tabs that opened
        yield
        for page in pages:
            ahead = _clock_ahead(page)
            found = page.evaluate("() => window.updates")
            painted.updates.extend(at - ahead - 1e3 * time for at, time in found)
        browser.close()


def _clock_ahead(page: Any) -> float:
    """Return by how much the page's clock is ahead of CLOCK_MONOTONIC, ms, to half the shortest question."""
    found = []
    for _ in range(100):
        asked = time.monotonic()
        at = float(page.evaluate("() => performance.now()"))
        answered = time.monotonic()
        found.append((answered - asked, at - 500.0 * (asked + answered)))
    return min(found)[1]


_UPDATES = """window.updates = [];
const listen = EventSource.prototype.addEventListener;
EventSource.prototype.addEventListener = function (topic, action, ...more) {
  const then = topic !== "state" ? action : (event) => {
    action(event);
    const { time, tick } = JSON.parse(event.data);
    requestAnimationFrame(() => {
      const channel = new MessageChannel();
      channel.port1.onmessage = () => {
        const shown = document.getElementById("loop").textContent.includes(tick);
        if (shown) window.updates.push([performance.now(), time]);
      };
      channel.port2.postMessage(0);
    });
  };
  return listen.call(this, topic, then, ...more);
};"""
"""Notes the time (ms) at which a state is on the screen, and that of its tick (s): a message that is posted
in the callback before a frame arrives after that frame."""


_FIRST_FIGURE = """new MutationObserver(() => {
  const word = document.getElementById("state-word")?.textContent ?? "–";
  if (window.firstFigure === undefined && word !== "–") window.firstFigure = performance.now();
}).observe(document, { childList: true, subtree: true, characterData: true });"""
"""Notes the time (ms) at which the document shows the bench's state."""


def _timing(
    bench: BenchProcess, seconds: float, counts: dict[str, np.ndarray[Any, Any]], row: int
) -> dict[str, float]:
    """Return the loop's timing over `seconds`: percentiles in µs, and counts; add to `row` of `counts`."""
    reader = TimingReader(bench.folder / TIMING_FILE)
    try:
        before = reader.snapshot()
        time.sleep(seconds)
        after = reader.snapshot()
    finally:
        reader.close()
    found = summary(after, before)
    for name, count in counts.items():
        segment = SEGMENTS.index(name)
        count[row] += after["count"][0, segment] - before["count"][0, segment]
    segments = found["segments"]
    return {
        f"{part} {level.removesuffix('_us')}": segments[part][level]
        for part in ("wake_up", "tick")
        for level in ("p50_us", "p99_us", "p999_us")
    } | {"late ticks": found["late"], "skipped ticks": found["skipped"]}


_SHOWN = {"wake_up": "Woken late", "tick": "Work of a tick"}
"""Segments whose histograms are printed."""


def _print_histograms(counts: dict[str, np.ndarray[Any, Any]], pages: int) -> None:
    """Print the histograms without and with pages beside each other, in half octaves."""
    from rich.console import Console
    from rich.table import Table

    edges = upper_edges()
    for name, (alone, beside) in counts.items():
        table = Table(title=f"{_SHOWN[name]}, share of ticks")
        for column in ("up to, µs", "no page", "", f"{pages} pages", ""):
            table.add_column(column, justify="right" if column else "left")
        groups = np.append(0, 1 + (np.arange(len(edges) - 1) // 8))
        shares = [np.bincount(groups, one) / max(one.sum(), 1) for one in (alone, beside)]
        for group in np.flatnonzero(shares[0] + shares[1]):
            last = edges[np.flatnonzero(groups == group)[-1]]
            edge = "above" if last == edges[-1] else f"{last / 1e3:.1f}"
            cells = [text for share in shares for text in (f"{100 * share[group]:.3f} %", _bar(share[group]))]
            table.add_row(edge, *cells)
        Console(width=110).print(table)


def _bar(share: float) -> str:
    return "█" * round(30 * share)


def wait_for_page(port: int) -> None:
    deadline = time.monotonic() + _START
    while True:
        with suppress(OSError):
            _first_figure(port)
            return
        if time.monotonic() > deadline:
            raise RuntimeError("the page does not start")
        time.sleep(0.2)


def messages(port: int, topic: str) -> Iterator[tuple[float, dict[str, Any]]]:
    """Yield the time of arrival (s, CLOCK_MONOTONIC) and the content of each message on `topic`."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    try:
        connection.request("GET", "/api/stream")
        response = connection.getresponse()
        while line := response.readline():
            if line == f"event: {topic}\n".encode():
                content = response.readline()
                yield time.monotonic(), json.loads(content.removeprefix(b"data: "))
    finally:
        connection.close()


def _first_figure(port: int) -> float:
    """Return the time from the connection to the first state, with all files of the page before, s."""
    began = time.monotonic()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    try:
        connection.request("GET", "/")
        names = re.findall(rb"/static/[a-z.]+", connection.getresponse().read())
        scripts = {f"/static/{name}" for name in static_files() if name.endswith(".js")}
        for path in scripts | {name.decode() for name in names}:
            connection.request("GET", path)
            connection.getresponse().read()
    finally:
        connection.close()
    at, _ = next(messages(port, "state"))
    return at - began


@contextmanager
def _readers(port: int, number: int, ages: list[tuple[float, float]]) -> Iterator[None]:
    """Keep `number` pages open; add each state's age from its tick and from its arrival at the page, s."""
    over = threading.Event()

    def read() -> None:
        for count, (at, state) in enumerate(messages(port, "state")):
            if over.is_set():
                return
            if count > 1:  # the first ones waited for the reader
                ages.append((at - state["time"], at - state["seen"]))

    threads = [threading.Thread(target=read) for _ in range(number)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()
