"""The supervisor's link to the loop: orders go into shared memory, answers are read from the ring.

Waiting for the loop is bounded, and it never computes anything on request: its newest record contains
state, request answered last and reason.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.base.lifecycle import Answer, Refusal, Request, State
from bench.network.bench_service import CommandAnswer, refused
from bench.records.telemetry.ring import RingReader
from bench.supervisor._supervision import SUPERVISION, SUPERVISION_FILE
from bench.supervisor.child_process import (
    CORRECTED,
    CORRECTED_FILE,
    CORRECTION,
    CORRECTION_FILE,
    RING_FILE,
    pack_correction,
)
from bench.supervisor.status import refusal_words
from drivers.base.shared_memory import SharedRecord

Cycles = np.ndarray[Any, Any]

_ANSWER = 0.2
"""Time-out of the loop's answer, s."""
_POLL_PERIOD = 0.001
_COUNTERS = {Request.STOP: "stop_count", Request.EMERGENCY_STOP: "emergency_stop_count"}


class LoopLink:
    """Orders to the loop and its records; every method may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        """Create the file of orders in the bench's `folder`, before the loop is started.

        Raises:
            SharedMemoryError: it cannot be created.
        """
        self._folder = folder
        self._shared = SharedRecord.create(folder / SUPERVISION_FILE, SUPERVISION)
        self._orders = np.zeros(1, SUPERVISION)
        self._corrections = SharedRecord.create(folder / CORRECTION_FILE, CORRECTION)
        self._corrections_ordered = 0
        self._corrected: SharedRecord | None = None
        self._order_lock, self._request_lock, self._look_lock = (threading.Lock() for _ in range(3))
        self._looks: RingReader | None = None
        self._stops_seen = dict.fromkeys(_COUNTERS, 0)
        self._news: RingReader | None = None
        self.fault = ""
        """Why the device does not follow commands; empty while it does."""

    def connect(self) -> None:
        """Open the ring created by the loop.

        Raises:
            NoRing: the ring is missing.
        """
        self._looks = RingReader(self._folder / RING_FILE)
        self._news = RingReader(self._folder / RING_FILE, from_oldest=True)
        self._corrected = SharedRecord.open(self._folder / CORRECTED_FILE, CORRECTED)

    def close(self) -> None:
        """Unmap all files."""
        for shared in (self._looks, self._news, self._corrected):
            if shared is not None:
                shared.close()
        self._corrections.close()
        self._shared.close()

    def beat(self, *, lease: int, support_ready: bool) -> None:
        """Send heartbeat and permissions to the loop; `lease` is the lease's number, 0 if not held."""
        self._order(heartbeat=int(self._orders["heartbeat"][0]) + 1, lease=lease, support_ready=support_ready)

    def shut_down(self) -> None:
        """Order the loop to end as soon as the robot is at rest."""
        self._order(shutdown=True)

    def newest(self) -> Cycles | None:
        """Return the newest record (one-element array of CYCLE), None before the first."""
        with self._look_lock:
            return None if self._looks is None else self._looks.newest()

    @property
    def state(self) -> str:
        """Name of the bench state."""
        newest = self.newest()
        return State.STARTING.name if newest is None else State(int(newest["state"][0])).name

    def news(self) -> Cycles:
        """Return the records since the last call; for one thread that calls it many times a second."""
        if self._news is None:
            raise RuntimeError("call connect() first")
        cycles = self._news.read(1 << 16)
        for request in _COUNTERS:
            self._stops_seen[request] += int(np.count_nonzero(cycles["request"] == request))
        return cycles

    def request(self, request: Request) -> CommandAnswer:
        """Send `request` to the loop and wait for its answer; one at a time.

        One that the loop has not taken in time is withdrawn, so that it is not done after its refusal.
        """
        with self._request_lock:
            number = int(self._orders["request_number"][0]) + 1
            lease = int(self._orders["lease"][0])
            self._order(request=request, request_number=number, request_lease=lease)
            if (reply := self._wait(lambda: self._answer_to(number))) is None:
                self._order(request=0)
                reply = self._wait(lambda: self._answer_to(number))  # taken just before
        return reply or refused(self.state, Refusal.LOOP_SILENT)

    def _answer_to(self, number: int) -> CommandAnswer | None:
        newest = self.newest()
        if newest is None or newest["request_number"][0] < number:
            return None
        state = State(int(newest["state"][0])).name
        if newest["answer"][0] == Answer.ACCEPTED:
            return CommandAnswer(True, state)
        refusal = Refusal(int(newest["refusal"][0]))
        return refused(state, refusal, *refusal_words(refusal, self.fault, newest["air_fault"][0]))

    def _wait(self, answer: Callable[[], CommandAnswer | None]) -> CommandAnswer | None:
        """Return the `answer` of the loop as soon as there is one; None after the time-out."""
        deadline = time.monotonic() + _ANSWER
        while True:
            late = time.monotonic() >= deadline  # looked at once more: this process may have stood still
            if (found := answer()) is not None or late:
                return found
            time.sleep(_POLL_PERIOD)

    def correct(self, weights: Sequence[float]) -> CommandAnswer:
        """Order a correction of the following swings and wait for the loop's answer; one at a time."""
        with self._request_lock:
            self._corrections_ordered += 1
            self._corrections.write(pack_correction(self._corrections_ordered, weights))
            return self._wait(self._answer_to_correction) or refused(self.state, Refusal.LOOP_SILENT)

    def _answer_to_correction(self) -> CommandAnswer | None:
        active = self._active_correction()
        if active["asked"] != self._corrections_ordered:
            return None
        if active["order"]["number"] == self._corrections_ordered:
            return CommandAnswer(True, self.state)
        return refused(self.state, Refusal.MOVING, action="correct it at rest or at address")

    @property
    def correction(self) -> int:
        """Number of the active correction; 0 for the profile as designed."""
        order = self._active_correction()["order"]
        return int(order["number"]) if order["size"] else 0

    def _active_correction(self) -> Any:
        active = np.zeros(1, CORRECTED)
        if self._corrected is not None:
            self._corrected.read(active)
        return active[0]

    def stop(self, request: Request) -> CommandAnswer:
        """Send STOP or EMERGENCY_STOP to the loop, ahead of other requests; wait until it is received."""
        counter, seen = _COUNTERS[request], self._stops_seen[request]
        with self._order_lock:
            self._orders[counter] += 1
            self._shared.write(self._orders)
        accepted = self._wait(
            lambda: CommandAnswer(True, self.state) if self._stops_seen[request] > seen else None
        )
        return accepted or refused(self.state, Refusal.LOOP_SILENT)

    def _order(self, **values: int) -> None:
        with self._order_lock:
            for name, value in values.items():
                self._orders[name] = value
            self._shared.write(self._orders)
