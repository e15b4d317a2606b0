"""Subscription of a viewer to a bench over zenoh, with counts of lost messages and their age.

zenoh's threads put messages into bounded queues, which one thread empties. A viewer that is too slow loses
the oldest messages and counts them; the bench never waits. zenoh reconnects automatically; a publisher
that counts from 1 again was restarted, which is not a loss.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, Self

import zenoh

from bench.base.address import root_key
from bench.base.errors import BenchError
from bench.base.json_schema import json_object
from bench.network.zenoh_session import close_session
from bench.records.telemetry.batches import Batch, decode_batch

TOPICS = ("telemetry", "state", "event", "shot", "loop")
"""Last parts of the subscribed keys."""

_QUEUED = 256
"""Max queued batches, and other messages: five seconds, about 10 MB."""


class Arrived(NamedTuple):
    """A batch of cycles and its time of arrival (UTC, s since 1970)."""

    batch: Batch
    at: float

    @property
    def age(self) -> float:
        """Time from the newest cycle's tick to its arrival, s; as accurate as the clocks of two machines."""
        return self.at - self.batch.time


class News(NamedTuple):
    """Messages received since the last call, in order."""

    batches: list[Arrived]
    messages: list[tuple[str, dict[str, Any]]]
    """Topic and JSON object of all other messages."""


class FeedCounts(NamedTuple):
    """Lost and invalid messages since the feed was opened."""

    batches: int = 0
    lost_batches: int = 0
    """Batches lost on the network or in this viewer's queue: gaps of the publisher's numbers."""
    lost_cycles: int = 0
    """Cycles lost in the ring, before the publisher."""
    invalid: int = 0
    restarts: int = 0


class Feed:
    """A subscription to all messages of a bench."""

    def __init__(self, session: zenoh.Session, bench: str, topics: Sequence[str] = TOPICS) -> None:
        """Subscribe to `topics` on `session`, closed with the feed."""
        self._session = session
        self._batches: deque[tuple[float, bytes]] = deque(maxlen=_QUEUED)
        self._others: deque[tuple[str, bytes]] = deque(maxlen=_QUEUED)
        self._arrived = threading.Event()
        self._sequence, self._ring_lost = 0, 0
        self.account = FeedCounts()
        self.fault = ""
        """Last invalid message."""
        self._subscribers = [
            session.declare_subscriber(
                f"{root_key(bench)}/{topic}",
                zenoh.handlers.Callback(partial(self._receive, topic), indirect=False),
            )
            for topic in topics
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def take(self, timeout: float) -> News:
        """Return received messages; wait up to `timeout` s for the first telemetry or event."""
        self._arrived.wait(timeout)
        self._arrived.clear()
        batches = []
        while self._batches:
            at, payload = self._batches.popleft()
            try:
                batch = decode_batch(payload)
            except BenchError as error:
                self.count_invalid(str(error))
                continue
            self._count(batch)
            batches.append(Arrived(batch, at))
        messages = []
        while self._others:
            topic, payload = self._others.popleft()
            if (read := json_object(payload)) is None:
                self.count_invalid(f"{topic}: no JSON object")
            else:
                messages.append((topic, read))
        return News(batches, messages)

    def close(self) -> None:
        """End the subscription and the session."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        close_session(self._session)

    def count_invalid(self, what: str) -> None:
        """Count a message with invalid content."""
        self.account = self.account._replace(invalid=self.account.invalid + 1)
        self.fault = what

    def _receive(self, topic: str, sample: zenoh.Sample) -> None:
        """Queue a message: called in zenoh's thread, it neither blocks nor raises."""
        if topic == "telemetry":
            self._batches.append((time.time(), sample.payload.to_bytes()))
        else:
            self._others.append((topic, sample.payload.to_bytes()))
        self._arrived.set()

    def _count(self, batch: Batch) -> None:
        a, first = self.account, self._sequence == 0
        restarted = not first and batch.sequence <= self._sequence
        missing = 0 if first else batch.sequence - (1 if restarted else self._sequence + 1)
        before = batch.lost if first else 0 if restarted else self._ring_lost
        self.account = a._replace(
            batches=a.batches + 1,
            lost_batches=a.lost_batches + missing,
            lost_cycles=a.lost_cycles + max(0, batch.lost - before),
            restarts=a.restarts + restarted,
        )
        self._sequence, self._ring_lost = batch.sequence, batch.lost
