"""A publish-only bench: it publishes given cycles over zenoh as the daemon and its publisher do."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import zenoh

from bench.base.address import free_port
from bench.config import NetworkSettings
from bench.network.zenoh_session import open_daemon
from bench.records.telemetry.batches import encode_batch

Cycles = np.ndarray[Any, Any]
BENCH = "b1"


def loopback() -> NetworkSettings:
    return NetworkSettings(f"tcp/127.0.0.1:{free_port()}")


class FakeBench:
    def __init__(self, session: zenoh.Session) -> None:
        self.session, self.sequence, self.lost = session, 0, 0

    def put(self, topic: str, payload: bytes) -> None:
        self.session.put(f"golfbench/{BENCH}/{topic}", payload)

    def tell(self, topic: str, **content: Any) -> None:
        self.put(topic, json.dumps(content).encode())

    def send(self, cycles: Cycles, utc: float | None = None) -> None:
        for part in np.split(cycles, range(20, len(cycles), 20)):
            self.sequence += 1
            utc_now = time.time() if utc is None else utc
            self.put("telemetry", encode_batch(part, self.sequence, self.lost, utc_now))


@contextmanager
def fake_bench(network: NetworkSettings) -> Iterator[FakeBench]:
    with open_daemon(network) as session:
        yield FakeBench(session)
