"""The supervisor's side of the loop: orders go into shared memory, answers are read from the ring.

The loop is never waited for beyond a bound, and never asked to compute anything: its newest record tells
state, request answered last and reason.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench.lifecycle import REFUSAL_TEXT, Answer, Refusal, Request, State
from bench.network.desk import Reply
from bench.processes.plan import RING_FILE
from bench.processes.supervision import SUPERVISION, SUPERVISION_FILE
from bench.telemetry.ring import RingReader
from sim.shared_record import SharedRecord

Cycles = np.ndarray[Any, Any]

_ANSWER = 0.2
"""s in which the loop must have answered."""
_BETWEEN_LOOKS = 0.001
_COUNTERS = {Request.STOP: "stop_count", Request.EMERGENCY_STOP: "emergency_stop_count"}


class LoopLink:
    """Orders to the loop and what it tells; every method may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        """Make the file of orders in the bench's `folder`; the loop may be started now.

        Raises:
            SharedMemoryError: it cannot be made.
        """
        self._folder = folder
        self._shared = SharedRecord.create(folder / SUPERVISION_FILE, SUPERVISION)
        self._orders = np.zeros(1, SUPERVISION)
        self._order_lock, self._request_lock, self._look_lock = (threading.Lock() for _ in range(3))
        self._looks: RingReader | None = None
        self._stops_seen = dict.fromkeys(_COUNTERS, 0)
        self._news: RingReader | None = None

    def connect(self) -> None:
        """Open the ring, which the loop has made.

        Raises:
            NoRing: there is none.
        """
        self._looks = RingReader(self._folder / RING_FILE)
        self._news = RingReader(self._folder / RING_FILE, from_oldest=True)

    def close(self) -> None:
        """Unmap all files."""
        for reader in (self._looks, self._news):
            if reader is not None:
                reader.close()
        self._shared.close()

    def beat(self, *, lease_held: bool, support_ready: bool) -> None:
        """Tell the loop that its supervisor lives, and what is granted."""
        self._order(
            heartbeat=int(self._orders["heartbeat"][0]) + 1,
            lease_held=lease_held,
            support_ready=support_ready,
        )

    def shut_down(self) -> None:
        """Order the loop to end as soon as the robot stands."""
        self._order(shutdown=True)

    def newest(self) -> Cycles | None:
        """Return the newest record (one-element array of CYCLE), None before the first."""
        with self._look_lock:
            return None if self._looks is None else self._looks.newest()

    @property
    def state(self) -> str:
        """Name of the state of the bench."""
        newest = self.newest()
        return State.STARTING.name if newest is None else State(int(newest["state"][0])).name

    def news(self) -> Cycles:
        """Return the records since the last call; for one thread, which calls it many times a second."""
        if self._news is None:
            raise RuntimeError("connect() comes first")
        cycles = self._news.read(1 << 16)
        for request in _COUNTERS:
            self._stops_seen[request] += int(np.count_nonzero(cycles["request"] == request))
        return cycles

    def request(self, request: Request) -> Reply:
        """Put `request` to the loop and wait for its answer; one at a time."""
        with self._request_lock:
            number = int(self._orders["request_number"][0]) + 1
            self._order(request=request, request_number=number)
            deadline = time.monotonic() + _ANSWER
            while time.monotonic() < deadline:
                newest = self.newest()
                if newest is not None and newest["request_number"][0] >= number:
                    return _reply(newest)
                time.sleep(_BETWEEN_LOOKS)
        return Reply(False, self.state, "the loop does not answer: it may stand still; look at its timing")

    def stop(self, request: Request) -> Reply:
        """Put `request`, STOP or EMERGENCY_STOP, to the loop, past any other; wait until it was seen."""
        counter, seen = _COUNTERS[request], self._stops_seen[request]
        with self._order_lock:
            self._orders[counter] += 1
            self._shared.write(self._orders)
        deadline = time.monotonic() + _ANSWER
        while time.monotonic() < deadline:
            if self._stops_seen[request] > seen:
                return Reply(True, self.state, "")
            time.sleep(_BETWEEN_LOOKS)
        return Reply(False, self.state, "the loop does not answer: press the button beside the robot")

    def _order(self, **values: int) -> None:
        with self._order_lock:
            for name, value in values.items():
                self._orders[name] = value
            self._shared.write(self._orders)


def _reply(newest: Cycles) -> Reply:
    state = State(int(newest["state"][0])).name
    if newest["answer"][0] == Answer.ACCEPTED:
        return Reply(True, state, "")
    return Reply(False, state, REFUSAL_TEXT[Refusal(int(newest["refusal"][0]))])
