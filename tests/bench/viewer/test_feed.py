from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, Self

import numpy as np
import pytest

from bench.base.lifecycle import State
from bench.network.zenoh_session import open_client
from bench.viewer.feed import TOPICS, Arrived, Feed
from tests.bench.records.telemetry.fake_bench import BENCH, FakeBench, fake_bench, loopback

Cycles = np.ndarray[Any, Any]
MakeDay = Callable[..., Cycles]
HURRY = 15.0


class Heard:
    def __init__(self, bench: FakeBench, feed: Feed) -> None:
        self.bench, self.feed = bench, feed
        self.batches: list[Arrived] = []
        self.messages: list[tuple[str, dict[str, Any]]] = []

    def until(self, enough: Callable[[], bool], nudge: Callable[[], None] = lambda: None) -> None:
        deadline = time.monotonic() + HURRY
        while not enough():
            assert time.monotonic() < deadline, "nothing came"
            nudge()
            news = self.feed.take(0.05)
            self.batches += news.batches
            self.messages += news.messages

    def subscribed(self) -> Self:
        """Wait until messages of the last topic get through: each subscription takes its time."""
        self.until(lambda: bool(self.messages), lambda: self.bench.tell(TOPICS[-1], state="READY"))
        self.messages.clear()
        return self

    @property
    def ticks(self) -> list[int]:
        return [int(tick) for arrived in self.batches for tick in arrived.batch.cycles["tick"]]


@pytest.fixture
def heard() -> Iterator[Heard]:
    network = loopback()
    with fake_bench(network) as bench, Feed(open_client(network, BENCH), BENCH) as feed:
        yield Heard(bench, feed).subscribed()


def test_feed_delivers_cycles_in_order_without_loss(heard: Heard, make_day: MakeDay) -> None:
    heard.bench.send(make_day([(State.READY, 200)]))
    heard.bench.tell("event", event="change", state="ARMED")
    heard.until(lambda: len(heard.ticks) == 200 and ("event" in dict(heard.messages)))
    assert heard.ticks == list(range(1, 201))
    assert heard.feed.account.batches == 10
    assert heard.feed.account[1:] == (0, 0, 0, 0)
    assert all(0 <= arrived.age < HURRY for arrived in heard.batches)


def test_feed_counts_losses_of_network_and_ring(heard: Heard, make_day: MakeDay) -> None:
    bench, day = heard.bench, make_day([(State.READY, 60)])
    bench.lost = 7  # before this viewer was there: not its loss
    bench.send(day[:20])
    bench.sequence += 3
    bench.lost = 12
    bench.send(day[20:])
    heard.until(lambda: len(heard.ticks) == 60)
    assert heard.feed.account.lost_batches == 3
    assert heard.feed.account.lost_cycles == 5


def test_feed_slow_viewer_drops_oldest_batches(heard: Heard, make_day: MakeDay) -> None:
    bench, day = heard.bench, make_day([(State.READY, 20)])
    bench.send(day)
    heard.until(lambda: len(heard.batches) == 1)
    for _ in range(400):
        bench.send(day)
        time.sleep(0.0005)
    newest = bench.sequence
    heard.until(lambda: bool(heard.batches) and heard.batches[-1].batch.sequence == newest)
    assert len(heard.batches) <= 1 + 256 + 5
    assert heard.feed.account.batches + heard.feed.account.lost_batches == newest


def test_feed_invalid_messages_are_counted(heard: Heard, make_day: MakeDay) -> None:
    for topic, payload in (("telemetry", b"cycles"), ("state", b"{"), ("event", b"[1]"), ("shot", b"\xff")):
        heard.bench.put(topic, payload)
    heard.bench.send(make_day([(State.READY, 20)]))
    heard.until(lambda: len(heard.ticks) == 20 and heard.feed.account.invalid == 4)
    assert heard.feed.fault


def test_feed_bench_restart_resumes_and_counts_restart(make_day: MakeDay) -> None:
    network, day = loopback(), make_day([(State.READY, 40)])
    with fake_bench(network) as bench:
        feed = Feed(open_client(network, BENCH), BENCH)
        heard = Heard(bench, feed).subscribed()
        bench.send(day[:20])
        heard.until(lambda: len(heard.ticks) == 20)
        bench.send(day[20:])
        heard.until(lambda: len(heard.ticks) == 40)
    try:
        assert not feed.take(0.2).batches
        with fake_bench(network) as heard.bench:
            heard.subscribed().bench.send(day)
            heard.until(lambda: len(heard.ticks) == 80)
            assert feed.account.restarts == 1
            assert feed.account.lost_batches == 0
    finally:
        feed.close()
