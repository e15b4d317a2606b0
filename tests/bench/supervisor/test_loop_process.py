"""Warm-up of the loop's process: ticks are measured until they keep to their share of the period."""

from __future__ import annotations

import mmap
import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import pytest

from bench.base.errors import Refused
from bench.base.lifecycle import Phase, Request
from bench.control.step_records import CONTROL_STATE
from bench.supervisor import loop_process
from bench.supervisor._supervision import SUPERVISION, SUPERVISION_FILE, Orders
from bench.supervisor._timing_record import STAMPS, Stall
from bench.supervisor.child_process import Parent
from bench.supervisor.loop_process import WARM_UP, LoopProcess, ThreadUsage, stall_between, usage_reader
from drivers.base.compile_report import CompileProgress
from drivers.base.compiled import new_record
from drivers.base.shared_memory import SharedRecord

MS = 1_000_000
BEFORE = ThreadUsage(page_faults=7, preemptions=3, waited=5 * MS)


@pytest.mark.parametrize(
    ("after", "work", "stall"),
    [
        (BEFORE._replace(waited=8 * MS), MS // 10, Stall.PREEMPTION),
        (BEFORE._replace(waited=8 * MS, page_faults=9), MS // 10, Stall.PREEMPTION),
        (BEFORE._replace(page_faults=8), MS // 10, Stall.PAGE_FAULT),
        (BEFORE, 3 * MS, Stall.LONG_TICK),
        (BEFORE, MS // 10, Stall.MACHINE),
        (BEFORE._replace(preemptions=4), MS // 10, Stall.MACHINE),  # a short one does not explain 4 ms
    ],
)
def test_stall_between_late_tick_names_stall(after: ThreadUsage, work: int, stall: Stall) -> None:
    assert stall_between(BEFORE, after, 4 * MS, work, MS) is stall


def test_stall_between_without_wait_time_names_preemption() -> None:
    before = ThreadUsage(page_faults=7, preemptions=3)
    assert stall_between(before, before._replace(preemptions=4), 4 * MS, 0, MS) is Stall.PREEMPTION


def test_usage_reader_counts_page_faults_of_thread() -> None:
    with usage_reader() as read, mmap.mmap(-1, 64 * mmap.PAGESIZE) as fresh:
        before = read()
        for page in range(64):
            fresh[page * mmap.PAGESIZE] = 1
        time.sleep(0.001)
        after = read()
    assert after.page_faults > before.page_faults
    assert after.waited >= before.waited


@pytest.mark.parametrize(
    ("arguments", "gone", "kept", "expected"),
    [
        ([], False, True, ["compile", [loop_process.COMPILED, "7"]]),
        ([loop_process.COMPILED, "7"], False, True, ["compile", "run"]),
        ([], True, True, ["compile", "run"]),  # which ends at once
        ([], False, False, ["compile", "run"]),
    ],
)
def test_main_after_compilation_starts_again_once(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    arguments: list[str],
    gone: bool,
    kept: bool,
    expected: list[object],
) -> None:
    class Process:
        def __init__(self, plan: object, parent: Parent) -> None:
            assert parent.pid == (7 if arguments else os.getppid())
            parent.pid = 7

        def compile(self) -> None:
            progress.compiled.add(1)
            done.append("compile")

        def run(self) -> str:
            done.append("run")
            return "done"

    def execute(path: str, command: list[str]) -> NoReturn:
        done.append(command[-2:])
        raise SystemExit

    done: list[object] = []
    progress = CompileProgress()
    monkeypatch.setattr(loop_process, "LoopProcess", Process)
    monkeypatch.setattr(loop_process, "progress", progress)
    monkeypatch.setattr(loop_process, "read_plan", object)
    monkeypatch.setattr(Parent, "gone", gone)
    monkeypatch.setattr(Parent, "listen", lambda _: None)
    monkeypatch.setattr(loop_process, "cache_folder", lambda: tmp_path if kept else tmp_path / "missing")
    monkeypatch.setattr(loop_process, "send_event", lambda event, **_: None)
    monkeypatch.setattr(os, "execv", execute)
    monkeypatch.setattr(os, "lseek", lambda *_: 0)
    monkeypatch.setattr(sys, "argv", ["loop_process", *arguments])
    with suppress(SystemExit):
        loop_process.main()
    assert done == expected


PERIOD_NS = 1_000_000


def warming(busy: int) -> Any:
    """Return a loop whose first `busy` ticks take 1.2 ms, the others 0.2 ms."""
    loop: Any = object.__new__(LoopProcess)
    marks = np.zeros(len(STAMPS), np.int64)
    loop.cycle = SimpleNamespace(marks=marks, state=SimpleNamespace(control={"is_warmed_up": False}))
    loop.paced, loop._period_ns, loop.ticks = False, PERIOD_NS, 0

    def tick(clock: object) -> float:
        marks[:] = np.linspace(0, 1_200_000 if loop.ticks < busy else 200_000, len(marks))
        loop.ticks += 1
        return 0.0

    loop._tick = tick
    return loop


def test_warm_up_busy_at_start_repeats_measurement() -> None:
    loop = warming(busy=3 * WARM_UP)
    loop._warm_up(None)
    assert loop.cycle.state.control["is_warmed_up"]
    assert loop.ticks == 4 * WARM_UP
    assert loop.tick_ns == 200_000


def test_warm_up_ticks_over_budget_are_refused() -> None:
    loop = warming(busy=1_000_000)
    with pytest.raises(Refused, match=r"loop\.rate"):
        loop._warm_up(None)
    assert not loop.cycle.state.control["is_warmed_up"]
    assert loop.ticks < 20 * WARM_UP


@pytest.mark.parametrize("delay", [-1, 0, 1])
@pytest.mark.parametrize("request_", [Request.SWING, Request.STOP])
def test_live_shutdown_stops_before_request_of_same_tick(
    tmp_path: Path, delay: int, request_: Request
) -> None:
    """The loop looks for its end every 50 ticks, and stops in the tick after it has found one."""
    shared, given = SharedRecord.create(tmp_path / SUPERVISION_FILE, SUPERVISION), new_record(SUPERVISION)
    control, done, stop = new_record(CONTROL_STATE), list[int](), loop_process._POLL_TICKS

    def say(**values: int) -> None:
        for name, value in values.items():
            given[name] = value
        shared.write(given)

    say(heartbeat=1, lease=1, support_ready=True)
    loop: Any = object.__new__(LoopProcess)
    loop.period, loop.orders = 1e-3, Orders(tmp_path / SUPERVISION_FILE, 1e9)
    loop.cycle = SimpleNamespace(state=SimpleNamespace(control=control))
    loop.parent = SimpleNamespace(gone=False, stop_requested=False)
    loop._note_usage = loop._report_device = lambda: None
    control["phase"] = Phase.HOLD

    def tick(clock: object) -> float:
        if len(done) == stop - 1:
            say(heartbeat=2, shutdown=True)
        if len(done) == stop + delay:
            number = "stop_count" if request_ is Request.STOP else "request_number"
            say(heartbeat=3, request=request_, request_lease=1, **{number: 1})
        loop.orders.put(control, 1e-3 * len(done))
        done.append(int(control["request"][0]))
        control["request"] = 0
        if len(done) > stop + 5:
            control["phase"] = Phase.STANDING
        return 1e-3 * len(done)

    loop._tick = tick
    assert loop._live(None) == "ordered by its supervisor"
    assert done[stop] == Request.STOP
    if request_ is not Request.STOP:
        assert done.index(request_) == stop + (delay or 1)
    loop.orders.close()
    shared.close()
