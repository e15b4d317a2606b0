"""The publisher as its supervisor and its subscribers meet it, with a loop that only writes."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import zenoh

from bench.base.address import free_port
from bench.base.lifecycle import State
from bench.config import NetworkSettings
from bench.network.zenoh_session import open_client, open_daemon
from bench.records.telemetry.batches import Batch, decode_batch
from bench.supervisor.child_process import Condition, PublisherPlan
from bench.supervisor.publisher import Publisher
from tests.bench.supervisor.service_bench import Cycles, ServiceBench, ServiceProcess, run_below
from tests.waiting import HURRY, wait_until

pytestmark = pytest.mark.live

MakeDay = Callable[..., Cycles]
DAEMON = """
import sys, time
from bench.config import NetworkSettings
from bench.network.zenoh_session import open_daemon
with open_daemon(NetworkSettings(sys.argv[1])):
    print("here", flush=True)
    time.sleep(60)
"""
SUBSCRIBER = """
import sys, time, zenoh
from bench.config import NetworkSettings
from bench.network.zenoh_session import open_client
with open_client(NetworkSettings(sys.argv[1]), "b1") as session:
    subscriber = session.declare_subscriber("golfbench/b1/**", zenoh.handlers.RingChannel(10))
    print("here", flush=True)
    time.sleep(60)
"""


class Bench(ServiceBench):
    """The daemon, a loop that writes given cycles, and the publisher."""

    def __init__(self, folder: Path, capacity: int) -> None:
        super().__init__(folder, "publisher", capacity)
        self.network = NetworkSettings(f"tcp/127.0.0.1:{free_port()}")
        self.plan = PublisherPlan("b1", self.network, folder)
        self.sessions: list[zenoh.Session] = []

    def listen(self) -> zenoh.Session:
        """Be the daemon."""
        self.sessions.append(open_daemon(self.network))
        return self.sessions[-1]

    def subscribe(self, name: str) -> zenoh.Subscriber[Any]:
        """Be a subscriber, as any client is."""
        self.sessions.append(open_client(self.network, "b1"))
        return self.sessions[-1].declare_subscriber(
            f"golfbench/b1/{name}", zenoh.handlers.FifoChannel(100_000)
        )

    def run_program(self, program: str) -> ServiceProcess:
        """Run a program with the endpoint, and wait until it is there."""
        process = self.run("-c", program, self.network.endpoint)
        assert process.line() == b"here"
        return process

    def start_anyhow(self) -> ServiceProcess:
        return self.run("-m", "bench.supervisor.publisher", plan=self.plan)

    def start(self) -> ServiceProcess:
        process = self.start_anyhow()
        assert process.event()["event"] == "ready"
        return process

    def wait_for_tick(self, tick: int) -> None:
        wait_until(lambda: self.heartbeat()["tick"] >= tick)

    def close(self) -> None:
        self.kill()
        for session in reversed(self.sessions):
            session.close()
        super().close()


def batches_up_to(subscriber: zenoh.Subscriber[Any], tick: int) -> list[Batch]:
    """Return all batches that come until one holds `tick`."""
    found: list[Batch] = []

    def look() -> bool:
        while (sample := subscriber.try_recv()) is not None:
            found.append(decode_batch(sample.payload.to_bytes()))
        return bool(found) and int(found[-1].cycles["tick"][-1]) >= tick

    wait_until(look)
    return found


def joined(batches: list[Batch]) -> bytes:
    return b"".join(batch.cycles.tobytes() for batch in batches)


@pytest.fixture
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Bench]:
    made = Bench(tmp_path, getattr(request, "param", 16384))
    yield made
    made.close()


@pytest.fixture
def day(make_day: MakeDay) -> MakeDay:
    """Return `day(ticks)` on the clock of this machine."""
    return lambda ticks, **more: make_day([(State.READY, ticks)], start=time.monotonic() - 1, **more)


def test_publisher_sends_each_cycle_once_bit_exact(bench: Bench, day: MakeDay) -> None:
    bench.listen()
    telemetry = bench.subscribe("telemetry")
    publisher = bench.start()
    time.sleep(0.3)  # until the subscription has got around
    cycles = day(1000)
    bench.write(cycles, pace=0.02)
    batches = batches_up_to(telemetry, 1000)
    assert joined(batches) == cycles.tobytes()
    assert [batch.sequence for batch in batches] == list(range(1, len(batches) + 1))
    assert 15 <= len(batches) <= 60
    assert {batch.lost for batch in batches} == {0}
    now = time.time() - time.monotonic()
    for batch in batches:
        assert batch.time == pytest.approx(now + batch.cycles["time"][-1], abs=0.5)
    publisher.terminate()
    assert publisher.wait(HURRY) == 0
    assert publisher.event() == {"event": "ended", "batches": len(batches), "lost": 0}
    assert bench.heartbeat()["condition"] == Condition.ENDING
    assert bench.heartbeat()["done"] == len(batches)


def test_publisher_messages_carry_source_time_and_encoding(bench: Bench, day: MakeDay) -> None:
    bench.listen()
    telemetry, loop = bench.subscribe("telemetry"), bench.subscribe("loop")
    bench.start()
    time.sleep(0.3)
    bench.write(day(10))
    samples: dict[str, zenoh.Sample] = {}
    for name, subscriber in (("telemetry", telemetry), ("loop", loop)):
        samples[name] = subscriber.recv()
    assert str(samples["telemetry"].encoding) == "application/vnd.apache.arrow.stream"
    assert str(samples["loop"].encoding) == "application/json"
    for sample in samples.values():
        assert sample.timestamp is not None
        assert abs(sample.timestamp.get_time().timestamp() - time.time()) < HURRY


def test_loop_message_counts_only_last_second(bench: Bench) -> None:
    bench.listen()
    loop = bench.subscribe("loop")
    marks = np.arange(7) * 10_000
    for k in range(5):
        bench.timing.note(marks + 1_000_000 * k, 1_000_000 * k, 1_000_000 * k)
    bench.start()
    for k in range(5, 25):
        bench.timing.note(marks + 1_000_000 * k, 1_000_000 * k, 1_000_000 * k)
    message = json.loads(loop.recv().payload.to_bytes())
    assert (message["version"], message["ticks"], message["skipped"], message["late"]) == (1, 20, 0, 0)
    assert message["segments"]["tick"]["count"] == 20
    assert message["segments"]["tick"]["p50_us"] == pytest.approx(60, rel=1 / 16)
    assert 0.9 < message["seconds"] < HURRY
    assert message["lost"] == message["batches"] == 0
    assert json.loads(loop.recv().payload.to_bytes())["ticks"] == 0


def test_publisher_late_subscriber_receives_later_cycles(bench: Bench, day: MakeDay) -> None:
    bench.listen()
    bench.start()
    cycles = day(2000)
    bench.write(cycles[:1000])
    bench.wait_for_tick(1000)
    telemetry = bench.subscribe("telemetry")
    time.sleep(0.3)
    bench.write(cycles[1000:])
    batches = batches_up_to(telemetry, 2000)
    assert joined(batches) == cycles[1000:].tobytes()
    assert batches[0].sequence > 1


def test_publisher_stopped_subscriber_bounds_memory_and_counts_loss(bench: Bench, day: MakeDay) -> None:
    daemon = psutil.Process(bench.run_program(DAEMON).pid)
    telemetry = bench.subscribe("telemetry")
    stopped = bench.run_program(SUBSCRIBER)
    publisher = psutil.Process(bench.start().pid)
    time.sleep(0.3)
    cycles = day(45_000)
    bench.write(cycles[:2000], pace=0.01)
    bench.wait_for_tick(2000)
    before = publisher.memory_info().rss, daemon.memory_info().rss
    stopped.send_signal(signal.SIGSTOP)
    bench.write(cycles[2000:], pace=0.002)  # over 30 MB of messages, more than the kernel's buffers take
    batches = batches_up_to(telemetry, 45_000)
    for process, memory in zip((publisher, daemon), before, strict=True):
        assert process.memory_info().rss - memory < 12 << 20
    # The writer is ten times faster than a loop: what is missing here is counted, never hidden.
    for earlier, later in pairwise(batches):
        if later.cycles["tick"][0] != earlier.cycles["tick"][-1] + 1:
            assert later.sequence > earlier.sequence + 1 or later.lost > earlier.lost
    assert sum(len(batch.cycles) for batch in batches) > 30_000
    stopped.send_signal(signal.SIGCONT)


@pytest.mark.parametrize("bench", [256], indirect=True)
def test_publisher_ring_overrun_counts_lost_cycles(bench: Bench, day: MakeDay) -> None:
    bench.listen()
    telemetry = bench.subscribe("telemetry")
    publisher = bench.start()
    time.sleep(0.3)
    cycles = day(1100)
    bench.write(cycles[:100])
    bench.wait_for_tick(100)
    publisher.send_signal(signal.SIGSTOP)
    bench.write(cycles[100:1000])
    publisher.send_signal(signal.SIGCONT)
    bench.wait_for_tick(1000)
    bench.write(cycles[1000:])
    batches = batches_up_to(telemetry, 1100)
    assert joined(batches) == cycles[:100].tobytes() + cycles[744:].tobytes()
    assert batches[0].lost == 0
    assert batches[-1].lost == 644 == bench.heartbeat()["lost"]


@pytest.mark.parametrize("bench", [256], indirect=True)
def test_publisher_cycles_before_open_session_count_no_loss(
    bench: Bench, day: MakeDay, monkeypatch: pytest.MonkeyPatch
) -> None:

    def slow(network: NetworkSettings, name: str) -> zenoh.Session:
        session = open_client(network, name)
        bench.write(day(1100))
        return session

    monkeypatch.setattr("bench.supervisor.publisher.open_client", slow)
    bench.listen()
    publisher = Publisher(bench.plan, time.monotonic())
    publisher.turn(time.monotonic(), time.time())
    assert publisher.lost == 0
    publisher.close()


def test_publisher_delayed_cycles_keep_source_time(bench: Bench, make_day: MakeDay) -> None:
    bench.listen()
    telemetry = bench.subscribe("telemetry")
    publisher = Publisher(replace(bench.plan, wall=False), time.monotonic())
    cycles = make_day([(State.READY, 600)])
    bench.write(cycles)
    while publisher.batches < 10:
        publisher.turn(time.monotonic(), 1e9)
    for batch in batches_up_to(telemetry, int(cycles["tick"][-1])):
        assert batch.time == pytest.approx(1e9 - (cycles["time"][-1] - batch.cycles["time"][-1]))
    publisher.close()


def test_publisher_without_daemon_reports_failed_and_exits(bench: Bench) -> None:
    publisher = bench.start_anyhow()
    told = publisher.event()
    assert (told["event"], told["exit_code"]) == ("failed", 75)
    assert bench.network.endpoint in told["location"]
    assert publisher.wait(HURRY) == 75


def test_publisher_lost_connection_reports_fault_and_recovers(bench: Bench, day: MakeDay) -> None:
    bench.listen()
    publisher = bench.start()
    bench.sessions.pop().close()
    assert publisher.event()["event"] == "fault"
    wait_until(lambda: bench.heartbeat()["condition"] == Condition.FAULT)
    bench.listen()
    assert publisher.event() == {"event": "recovered"}
    telemetry = bench.subscribe("telemetry")
    time.sleep(0.3)
    bench.write(day(50))
    assert len(joined(batches_up_to(telemetry, 50))) > 0


def test_publisher_stalled_daemon_terminates_promptly(bench: Bench, day: MakeDay) -> None:
    daemon = bench.run_program(DAEMON)
    stuck = bench.run_program(SUBSCRIBER)
    publisher = bench.start()
    daemon.send_signal(signal.SIGSTOP)
    stuck.send_signal(signal.SIGSTOP)
    bench.write(day(3000), pace=0.005)
    bench.wait_for_tick(3000)
    publisher.terminate()
    began = time.monotonic()
    publisher.wait(HURRY)
    assert time.monotonic() - began < 3.0
    for process in (daemon, stuck):
        process.send_signal(signal.SIGCONT)


def test_publisher_supervisor_killed_ends(bench: Bench) -> None:
    bench.listen()
    supervisor = bench.run("-c", run_below("bench.supervisor.publisher"), plan=bench.plan)
    assert supervisor.event()["event"] == "ready"
    supervisor.kill()
    assert supervisor.event()["event"] == "ended"  # the pipe is the publisher's too
