from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.base.lifecycle import State
from bench.network.zenoh_session import open_client
from bench.viewer.feed import Arrived, Feed
from tests.bench.records.telemetry.fake_bench import BENCH, FakeBench, fake_bench, loopback

Cycles = np.ndarray[Any, Any]
MakeDay = Callable[..., Cycles]
HURRY = 15.0


class Heard:
    def __init__(self, feed: Feed) -> None:
        self.feed = feed
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

    @property
    def ticks(self) -> list[int]:
        return [int(tick) for arrived in self.batches for tick in arrived.batch.cycles["tick"]]


def subscribed(bench: FakeBench, heard: Heard) -> None:
    """Wait until messages get through: a subscription takes its time."""
    heard.until(lambda: bool(heard.messages), lambda: bench.tell("state", state="READY"))
    heard.messages.clear()


def test_feed_delivers_cycles_in_order_without_loss(make_day: MakeDay) -> None:
    network = loopback()
    with fake_bench(network) as bench, Feed(open_client(network, BENCH), BENCH) as feed:
        heard = Heard(feed)
        subscribed(bench, heard)
        bench.send(make_day([(State.READY, 200)]))
        bench.tell("event", event="change", state="ARMED")
        heard.until(lambda: len(heard.ticks) == 200 and ("event" in dict(heard.messages)))
        assert heard.ticks == list(range(1, 201))
        assert feed.account.batches == 10
        assert feed.account[1:] == (0, 0, 0, 0)
        assert all(0 <= arrived.age < HURRY for arrived in heard.batches)


def test_feed_counts_losses_of_network_and_ring(make_day: MakeDay) -> None:
    network, day = loopback(), make_day([(State.READY, 60)])
    with fake_bench(network) as bench, Feed(open_client(network, BENCH), BENCH) as feed:
        heard = Heard(feed)
        subscribed(bench, heard)
        bench.lost = 7  # before this viewer was there: not its loss
        bench.send(day[:20])
        bench.sequence += 3
        bench.lost = 12
        bench.send(day[20:])
        heard.until(lambda: len(heard.ticks) == 60)
        assert feed.account.lost_batches == 3
        assert feed.account.lost_cycles == 5


def test_feed_slow_viewer_drops_oldest_batches(make_day: MakeDay) -> None:
    network, day = loopback(), make_day([(State.READY, 20)])
    with fake_bench(network) as bench, Feed(open_client(network, BENCH), BENCH) as feed:
        heard = Heard(feed)
        subscribed(bench, heard)
        bench.send(day)
        heard.until(lambda: len(heard.batches) == 1)
        for _ in range(400):
            bench.send(day)
            time.sleep(0.0005)
        newest = bench.sequence
        heard.until(lambda: bool(heard.batches) and heard.batches[-1].batch.sequence == newest)
        assert len(heard.batches) <= 1 + 256 + 5
        assert feed.account.batches + feed.account.lost_batches == newest


def test_feed_bench_restart_resumes_and_counts_restart(make_day: MakeDay) -> None:
    network, day = loopback(), make_day([(State.READY, 40)])
    with fake_bench(network) as bench:
        feed = Feed(open_client(network, BENCH), BENCH)
        heard = Heard(feed)
        subscribed(bench, heard)
        bench.send(day[:20])
        heard.until(lambda: len(heard.ticks) == 20)
        bench.send(day[20:])
        heard.until(lambda: len(heard.ticks) == 40)
    try:
        assert not feed.take(0.2).batches
        with fake_bench(network) as bench:
            subscribed(bench, heard)
            bench.send(day)
            heard.until(lambda: len(heard.ticks) == 80)
            assert feed.account.restarts == 1
            assert feed.account.lost_batches == 0
    finally:
        feed.close()


def test_feed_invalid_messages_are_counted(make_day: MakeDay) -> None:
    network = loopback()
    with fake_bench(network) as bench, Feed(open_client(network, BENCH), BENCH) as feed:
        heard = Heard(feed)
        subscribed(bench, heard)
        bench.put("telemetry", b"cycles")
        bench.put("state", b"{")
        bench.put("event", b"[1]")
        bench.put("shot", b"\xff")
        bench.send(make_day([(State.READY, 20)]))
        heard.until(lambda: len(heard.ticks) == 20 and feed.account.invalid == 4)
        assert feed.fault
