"""The publisher: reads the ring and sends telemetry over zenoh. `python -m bench.supervisor.publisher`.

Plan: a pickled PublisherPlan on stdin. Output on stdout, one JSON line each:

`ready`      connected to the daemon
`fault`      `text`: the connection is lost; it reconnects automatically
`recovered`  it is reconnected
`failed`     `location`, `found`, `expected`, `action`, `exit_code`: it cannot work at all
`ended`      `batches`, `lost`

It sends `golfbench/<id>/telemetry` (`bench.records.telemetry.batches`) about 50 times a second and
`golfbench/<id>/loop` (JSON) once a second. It never waits for subscribers: a slow one loses messages, visible
as gaps of their numbers, and costs no memory. It ends on SIGTERM or when its supervisor is gone.
"""

from __future__ import annotations

import json
import os
import signal
import time
from typing import Any

import numpy as np
import zenoh

from bench.base.address import root_key
from bench.base.errors import ExitCode
from bench.network.messages import LOOP_VERSION
from bench.network.zenoh_session import close_session, open_client
from bench.records.telemetry.batches import encode_batch
from bench.records.telemetry.cycle_record import MAX_BATCH_CYCLES
from bench.records.telemetry.ring import RingReader
from bench.supervisor._timing_record import TimingReader, summary
from bench.supervisor.child_process import (
    RING_FILE,
    TIMING_FILE,
    Condition,
    HeartbeatSender,
    PublisherPlan,
    begin_service,
    send_event,
)

PERIOD = 0.02
"""Period of the batches, s."""

_STATISTICS = 1.0
"""Period of the messages on `loop`, s."""
_MAX_BATCHES = 4
"""Max batches in one period when catching up."""
_GAP = 0.003
"""Time between two of them, s: a burst would be dropped on its way."""
_CLOSE_TIMEOUT = 1.5
"""Time-out for closing the session, s."""
_ARROW = "application/vnd.apache.arrow.stream"


class Publisher:
    """One run of the publisher; call `turn` once per period."""

    def __init__(self, plan: PublisherPlan, now: float) -> None:
        """Open the shared files and the session, at `now` (s, CLOCK_MONOTONIC).

        Raises:
            BenchError, SharedMemoryError: a shared file is unusable, or the endpoint is unreachable.
        """
        self._wall = plan.wall
        self._heartbeat = HeartbeatSender(plan.folder, "publisher")
        self._timing = TimingReader(plan.folder / TIMING_FILE)
        self._session = open_client(plan.network, plan.bench)
        declare, drop = self._session.declare_publisher, zenoh.CongestionControl.DROP
        key = root_key(plan.bench)
        self._telemetry = declare(f"{key}/telemetry", encoding=_ARROW, congestion_control=drop)
        self._loop = declare(f"{key}/loop", encoding=zenoh.Encoding.APPLICATION_JSON, congestion_control=drop)
        # Opened last: earlier records do not count as lost.
        self._ring = RingReader(plan.folder / RING_FILE)
        self.batches = 0
        self._connected = True
        self._statistics_at = now + _STATISTICS
        self._before, self._before_at = self._timing.snapshot(), now

    @property
    def lost(self) -> int:
        """Number of records lost in the ring."""
        return self._ring.lost

    def turn(self, now: float, utc: float, *, ending: bool = False) -> None:
        """Send new cycles, at `now` (s, CLOCK_MONOTONIC) and `utc` (s since 1970)."""
        newest = None if self._wall else self._ring.newest()
        loop_now = now if newest is None else float(newest["time"][0])
        for part in range(_MAX_BATCHES):
            cycles = self._ring.read(MAX_BATCH_CYCLES)
            if len(cycles):
                if part:
                    time.sleep(_GAP)
                self._send(cycles, utc - max(0.0, loop_now - float(cycles["time"][-1])))
            # Bounded: a batch takes longer than a tick, so there would always be another one.
            if len(cycles) < MAX_BATCH_CYCLES:
                break
        if now >= self._statistics_at:
            self._statistics_at = now + _STATISTICS
            self._send_statistics(now, utc)
            self._check_connection()
        working = Condition.WORKING if self._connected else Condition.FAULT
        condition = Condition.ENDING if ending else working
        self._heartbeat.beat(now, condition, lost=self._ring.lost, done=self.batches)

    def close(self) -> None:
        """Undeclare everything, close the session and unmap the shared files."""
        for entity in (self._telemetry, self._loop):
            entity.undeclare()
        close_session(self._session)
        self._heartbeat.close()
        self._ring.close()

    def _send(self, cycles: np.ndarray[Any, Any], utc: float) -> None:
        """Send one batch, whose newest cycle is at `utc` (s)."""
        self.batches += 1
        message = encode_batch(cycles, self.batches, self._ring.lost, utc)
        self._telemetry.put(message, timestamp=self._session.new_timestamp())
        self._heartbeat.last["tick"] = cycles["tick"][-1]

    def _send_statistics(self, now: float, utc: float) -> None:
        after = self._timing.snapshot()
        message: dict[str, Any] = {
            "version": LOOP_VERSION,
            "time": utc,
            "seconds": now - self._before_at,
            "batches": self.batches,
            "lost": self._ring.lost,
            **summary(after, self._before),
        }
        self._before, self._before_at = after, now
        self._loop.put(json.dumps(message, allow_nan=False), timestamp=self._session.new_timestamp())

    def _check_connection(self) -> None:
        connected = bool(self._session.info.peers_zid() or self._session.info.routers_zid())
        if connected and not self._connected:
            send_event("recovered")
        elif self._connected and not connected:
            send_event("fault", text="the connection to the daemon is lost")
        self._connected = connected


def main() -> int:
    """Publish until stopped by the supervisor or orphaned."""
    parent, publisher = begin_service(lambda plan: Publisher(plan, time.monotonic()))
    while not parent.wants_end:
        began = time.monotonic()
        publisher.turn(began, time.time())
        time.sleep(max(0.001, PERIOD - (time.monotonic() - began)))
    publisher.turn(time.monotonic(), time.time(), ending=True)
    # A daemon that takes nothing any more may hold the session's end up: the kernel ends it then.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, _CLOSE_TIMEOUT)
    batches, lost = publisher.batches, publisher.lost
    publisher.close()
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    send_event("ended", batches=batches, lost=lost)
    return ExitCode.OK


if __name__ == "__main__":
    # All is closed: the interpreter's own tidying up takes a busy machine a second.
    os._exit(main())
