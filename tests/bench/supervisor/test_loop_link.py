"""The supervisor's requests to a loop, and what becomes of them when one of the two stands still."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bench.base.lifecycle import Answer, Refusal, Request, State
from bench.control.step_records import CONTROL_STATE
from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.ring import RingWriter
from bench.supervisor._loop_link import LoopLink
from bench.supervisor._supervision import SUPERVISION_FILE, Orders
from bench.supervisor.child_process import CORRECTED, CORRECTED_FILE, RING_FILE
from drivers.base.compiled import new_record
from drivers.base.shared_memory import SharedRecord


class AnsweringLoop:
    """A loop that accepts every request and notes it."""

    def __init__(self, folder: Path) -> None:
        self.ring, self.orders = RingWriter(folder / RING_FILE, 64), Orders(folder / SUPERVISION_FILE, 1e9)
        self.corrected = SharedRecord.create(folder / CORRECTED_FILE, CORRECTED)
        self.control, self.cycle = new_record(CONTROL_STATE), new_record(CYCLE)
        self.done: list[int] = []

    def tick(self) -> None:
        self.control["request"] = 0
        self.orders.put(self.control, time.monotonic())
        if self.control["request"][0]:
            self.done.append(int(self.control["request"][0]))
            self.cycle["answer"] = Answer.ACCEPTED
            self.cycle["request_number"] = self.control["request_number"]
        self.cycle["state"] = State.ARMED
        self.ring(self.cycle)

    def close(self) -> None:
        self.ring.close()
        self.orders.close()
        self.corrected.close()


@pytest.fixture
def link(tmp_path: Path) -> Iterator[LoopLink]:
    made = LoopLink(tmp_path)
    yield made
    made.close()


@pytest.fixture
def loop(link: LoopLink, tmp_path: Path) -> Iterator[AnsweringLoop]:
    made = AnsweringLoop(tmp_path)
    link.connect()
    link.beat(lease=1, support_ready=True)
    made.tick()
    yield made
    made.close()


def test_loop_link_refused_request_is_not_executed_later(link: LoopLink, loop: AnsweringLoop) -> None:
    reply = link.request(Request.SWING)  # the loop stands still
    assert not reply.accepted
    assert reply.refusal == Refusal.LOOP_SILENT.name
    for _ in range(3):
        loop.tick()
    assert loop.done == []


def test_loop_link_request_after_refusal_is_accepted(link: LoopLink, loop: AnsweringLoop) -> None:
    link.request(Request.SWING)
    over = threading.Event()

    def run() -> None:
        while not over.is_set():
            loop.tick()
            time.sleep(0.001)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert link.request(Request.ARM).accepted
    finally:
        over.set()
        thread.join()
    assert loop.done == [Request.ARM]


def test_loop_link_answer_after_supervisor_stall_is_accepted(
    link: LoopLink, loop: AnsweringLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]

    def stand_still(_: float) -> None:
        loop.tick()
        now[0] += 10.0

    monkeypatch.setattr("bench.supervisor._loop_link.time.monotonic", lambda: now[0])
    monkeypatch.setattr("bench.supervisor._loop_link.time.sleep", stand_still)
    assert link.request(Request.SWING).accepted
    assert np.array_equal(loop.done, [Request.SWING])
