"""Telemetry end to end: the cycles of a running bench at a subscriber, against what its ring held.

The bench swings all the time. First with one subscriber; then another one is stopped (SIGSTOP) beside it, and
others are killed: the loop's timing, the publisher's memory and what was lost stand beside each other. By
the plant's own clock (`--clock wall`) a cycle bears the time of its tick and its age is exact; with the plant
in step the publisher's word for it is taken, so that its own delay of up to 20 ms is left out.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import Any, NamedTuple

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from bench.errors import BenchError
from bench.processes.plan import TIMING_FILE
from bench.processes.tick_timing import TimingReader, summary
from tests.benchmarks.row import Row
from tests.running_bench import BenchProcess, running_bench, write_configuration

_SUBSCRIBER = """
import json, sys, threading, time
import numpy as np, zenoh
from collections import deque
from pathlib import Path
from bench.config import load_configuration
from bench.telemetry.batches import decode_batch
from bench.network.zenoh_session import open_client
file, wall, found = Path(sys.argv[1]), sys.argv[2] == "wall", Path(sys.argv[3])
c = load_configuration(file)
came, over = deque(maxlen=2000), threading.Event()
def note(sample):
    came.append((time.monotonic(), time.time(), sample.payload.to_bytes()))
ticks, ages, count, size, newest, ring_lost = [], [], 0, 0, 0, [0, 0]
with open_client(c.network, c.bench.id) as session:
    session.declare_subscriber(
        f"golfbench/{c.bench.id}/telemetry", zenoh.handlers.Callback(note, indirect=False)
    )
    print("ready", flush=True)
    threading.Thread(target=lambda: (sys.stdin.read(), over.set()), daemon=True).start()
    while came or not over.is_set():
        if not came:
            time.sleep(0.005)
            continue
        at, utc, message = came.popleft()
        batch = decode_batch(message)
        if not count:
            first, ring_lost[0] = batch.sequence, batch.lost
        count, newest, ring_lost[1] = count + 1, batch.sequence, batch.lost
        size += len(message)
        ticks.append(batch.cycles["tick"])
        ages.append(at - batch.cycles["time"] if wall else utc - batch.time
                    + batch.cycles["time"][-1] - batch.cycles["time"])
np.savez(found, ticks=np.concatenate(ticks), ages=np.concatenate(ages))
print(json.dumps({"batches": count, "bytes": size, "lost_batches": newest - first + 1 - count,
                  "lost_in_ring": ring_lost[1] - ring_lost[0]}), flush=True)
"""
_SETTLING = 3.0
"""s from a subscriber's start to the first record that counts."""
_GROWTH = 12.0
"""MiB that the publisher may take for subscribers that do not take anything: queues of the links."""
_LIFE = 3.0
"""s that a subscriber lives which is to be killed."""
_STOPPED = "a subscriber stopped"
_KILLED = "subscribers killed"


class Subscriber:
    """A process that hears all telemetry of the bench."""

    def __init__(self, file: Path, clock: str, found: Path) -> None:
        self._found = found
        self.process = subprocess.Popen(
            [sys.executable, "-c", _SUBSCRIBER, str(file), clock, str(found)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        if self.process.stdout is None or self.process.stdout.readline() != b"ready\n":
            raise RuntimeError("the subscriber does not start")

    def end(self) -> tuple[dict[str, int], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """Return its counts, and tick and age (s) of each cycle it got."""
        told, _ = self.process.communicate(timeout=120.0)
        with np.load(self._found) as found:
            return json.loads(told), found["ticks"], found["ages"]

    def kill(self) -> None:
        """End it by force. Allowed twice."""
        self.process.kill()
        self.process.communicate()


class RingWatch:
    """Reads the ring beside the publisher: what there was to be heard, and how large the publisher grew."""

    def __init__(self, bench: BenchProcess) -> None:
        self._bench, self._publisher = bench, psutil.Process(bench.pid("publisher"))
        self.ticks: list[np.ndarray[Any, Any]] = []
        self.greatest = 0.0
        """MiB of the publisher since `measure` began."""
        while len(bench.cycles.read()):
            pass
        self._before = bench.cycles.lost

    @property
    def lost(self) -> int:
        """Records that this reader missed itself."""
        return int(self._bench.cycles.lost - self._before)

    def look(self) -> None:
        """Read on."""
        cycles = self._bench.cycles.read()
        while len(cycles):
            self.ticks.append(cycles["tick"].copy())
            cycles = self._bench.cycles.read()
        self.greatest = max(self.greatest, self._publisher.memory_full_info().uss / 2**20)

    def measure(self, timing: TimingReader, seconds: float, turn: Callable[[], None]) -> Phase:
        """Look for `seconds`, taking a `turn` again and again."""
        self.greatest = 0.0
        before, cpu, begin = timing.snapshot(), self._cpu(), time.monotonic()
        while time.monotonic() < begin + seconds:
            self.look()
            turn()
            time.sleep(0.2)
        share = (self._cpu() - cpu) / (time.monotonic() - begin)
        return Phase(summary(timing.snapshot(), before), share, self.greatest)

    def _cpu(self) -> float:
        spent = self._publisher.cpu_times()
        return float(spent.user + spent.system)


class Phase(NamedTuple):
    """How the bench did while something was done to its subscribers."""

    loop: dict[str, Any]
    """As `bench.processes.tick_timing.summary` gives it."""
    publisher_share: float
    """Of one processor."""
    publisher_memory: float
    """MiB at most."""

    def figures(self) -> list[tuple[str, str]]:
        """Return names and values for people."""
        segments = self.loop["segments"]
        parts = (("wake_up", "wake-up"), ("tick", "tick"), ("publish", "ring write"))
        keys = (("p50_us", "p50"), ("p99_us", "p99"), ("p999_us", "p99.9"), ("max_us", "greatest"))
        return [
            *(
                (f"{name}, {words}, us", f"{segments[s][key]:,.1f}")
                for s, name in parts
                for key, words in keys
            ),
            ("ticks", f"{self.loop['ticks']:,}"),
            ("skipped ticks", f"{self.loop['skipped']:,}"),
            ("publisher, % of a processor", f"{100.0 * self.publisher_share:.1f}"),
            ("publisher, MiB at most", f"{self.publisher_memory:.1f}"),
        ]


def beside(phases: dict[str, Phase]) -> Table:
    """Return the figures of all phases beside each other."""
    table = Table("the loop and the publisher", *phases, title_justify="left")
    for rows in zip(*(phase.figures() for phase in phases.values()), strict=True):
        table.add_row(rows[0][0], *(value for _, value in rows))
    return table


def swing_on(bench: BenchProcess, over: Event) -> None:
    """Swing until it is `over`; what stops the bench by itself is reset."""
    with bench.client.lease("telemetry"):
        while not over.is_set():
            try:
                bench.recover()
                bench.take_address()
                bench.swing()
                bench.client.wait_for("READY")
            except (BenchError, TimeoutError):
                time.sleep(0.5)


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Measure for `--minutes`, then `--disturbed` s with a stopped and with killed subscribers."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks telemetry_age")
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--disturbed", type=float, default=60.0, metavar="SECONDS", help="0: not at all")
    parser.add_argument("--clock", choices=("wall", "paced"), default="wall")
    options = parser.parse_args(arguments)
    phases: dict[str, Phase] = {}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        file = write_configuration(folder, "telemetry")
        bench = stack.enter_context(running_bench(file, clock=options.clock))
        timing = stack.enter_context(TimingReader(bench.folder / TIMING_FILE))

        def subscribe(name: str) -> Subscriber:
            made = Subscriber(file, options.clock, folder / f"{name}.npz")
            stack.callback(made.kill)
            return made

        over = Event()
        swinging = Thread(target=swing_on, args=(bench, over))
        stack.callback(swinging.join)
        stack.callback(over.set)
        swinging.start()
        undisturbed = subscribe("undisturbed")
        time.sleep(_SETTLING)
        watch = RingWatch(bench)
        phases["undisturbed"] = watch.measure(timing, 60.0 * options.minutes, lambda: None)
        stopped_counts: dict[str, int] = {}
        if options.disturbed:
            stopped = subscribe("stopped")
            time.sleep(_SETTLING)
            stopped.process.send_signal(signal.SIGSTOP)
            phases[_STOPPED] = watch.measure(timing, options.disturbed, lambda: None)
            stopped.process.send_signal(signal.SIGCONT)
            time.sleep(_SETTLING)
            stopped_counts, _, _ = stopped.end()
            victims: list[tuple[float, Subscriber]] = []

            def kill_and_start() -> None:
                now = time.monotonic()
                if not victims or now - victims[-1][0] > _LIFE:
                    if victims:
                        victims[-1][1].kill()
                    victims.append((now, subscribe(f"victim {len(victims)}")))

            phases[_KILLED] = watch.measure(timing, options.disturbed, kill_and_start)
            victims[-1][1].kill()
        time.sleep(0.5)
        watch.look()
        time.sleep(0.5)
        counts, heard, ages = undisturbed.end()
        lost_by_watch = watch.lost
        over.set()
        swinging.join()
        swings = bench.client.status()["swings"]
    told = np.concatenate(watch.ticks)
    told = told[told >= heard[0]]
    missing = np.setdiff1d(told, heard)
    title = f"telemetry, {options.minutes:g} min, {options.clock}"
    note = f"of {len(told):,}, in {counts['batches']:,} batches, {swings} swings"
    wire = 3600.0 * counts["bytes"] / ((heard[-1] - heard[0]) / 1000.0) / 1e9
    p50, p99, longest = 1e3 * np.quantile(ages, [0.5, 0.99, 1.0])
    rows = [
        Row(title, "records lost end to end", len(missing), "", note, at_most=0),
        Row(title, "of them told as lost", counts["lost_in_ring"], "", f"{counts['lost_batches']} batches"),
        Row(title, "records that the benchmark's own reader lost", lost_by_watch, "", at_most=0),
        Row(title, "records heard twice", len(heard) - len(np.unique(heard)), "", at_most=0),
        Row(title, "age, tick to subscriber, p50", p50, "ms", at_most=20.0),
        Row(title, "age, tick to subscriber, p99", p99, "ms", at_most=100.0),
        Row(title, "age, tick to subscriber, greatest", longest, "ms"),
    ]
    Console().print(beside(phases))
    first = phases["undisturbed"]
    rows += [
        Row(title, "publisher, of a processor", 100.0 * first.publisher_share, "%"),
        Row(title, "size of an hour on the wire", wire, "GB", "Arrow IPC batches"),
    ]
    for name, phase in phases.items():
        if phase is not first:
            growth = phase.publisher_memory - first.publisher_memory
            rows.append(Row(title, f"publisher's growth, {name}", growth, "MiB", at_most=_GROWTH))
    if stopped_counts:
        note = f"it heard {stopped_counts['batches']:,}; all are counted by number"
        rows.append(Row(title, "batches that the stopped one lost", stopped_counts["lost_batches"], "", note))
    return rows
