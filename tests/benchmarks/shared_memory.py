"""What publishing one cycle costs the loop: ring, shared record and zenoh, at 1 kHz with a reader on.

Blocks of each way in turn, in one run, on the wall clock, at real-time priority where that is granted. The
reader, another process, polls ring and record every 10 ms and subscribes to zenoh; it checks what it gets.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from bench.network.free_port import free_port
from bench.processes.bench_folder import MEMORY
from bench.telemetry.cycle_record import CYCLE
from bench.telemetry.ring import RingWriter
from drivers.base.shared_record import SharedRecord
from tests.benchmarks.row import Row

PERIOD = 0.001
"""s."""
BLOCK, ROUNDS = 500, 12
"""Ticks of one way before the next has its turn, and turns of each."""
PRIORITY = 80
KEY = "golfbench/benchmark/cycle"
PROMISED_MEDIAN, PROMISED_P99 = 10.0, 40.0
"""us, of ring and record, cold as they are at 1 kHz."""

_READER = """
import json, sys, time
from pathlib import Path
import numpy as np
import zenoh
from bench.telemetry.cycle_record import CYCLE
from bench.telemetry.ring import RingReader
from drivers.base.shared_record import SharedRecord

folder, key = Path(sys.argv[1]), sys.argv[3]
ring, record = RingReader(folder / "ring"), SharedRecord.open(folder / "record", CYCLE)
into = np.zeros(1, CYCLE)
got = dict(ring=0, record=0, zenoh=0)
with zenoh.open(zenoh.Config.from_json5(sys.argv[2])) as session:
    subscriber = session.declare_subscriber(key, zenoh.handlers.FifoChannel(100_000))
    print("ready", flush=True)
    sys.stdin.close()
    over = None
    while over is None or time.monotonic() < over:
        got["ring"] += len(ring.read())
        got["record"] = record.read(into)
        while (sample := subscriber.try_recv()) is not None:
            got["zenoh"] += len(sample.payload.to_bytes()) == CYCLE.itemsize
        if over is None and (folder / "over").exists():
            over = time.monotonic() + 0.5
        time.sleep(0.01)
print(json.dumps(got))
"""


def _network(role: str, endpoint: str) -> str:
    """Return the settings of a zenoh session that only listens on, or only connects to `endpoint`."""
    ends = {end: {"endpoints": [endpoint] if end == role else []} for end in ("listen", "connect")}
    scouting = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    transport = {"shared_memory": {"enabled": False}}  # it leaves files in /dev/shm
    return json.dumps({"mode": "peer", "scouting": scouting, "transport": transport, **ends})


def _paced(ways: dict[str, Callable[[np.ndarray[Any, Any]], object]]) -> dict[str, NDArray[np.float64]]:
    """Return the time (us) of each call, in blocks of each way in turn, one call a period."""
    record = np.zeros(1, CYCLE)
    times: dict[str, list[int]] = {name: [] for name in ways}
    number, due = 0, time.monotonic()
    for _ in range(ROUNDS):
        for name, publish in ways.items():
            for _ in range(BLOCK):
                due = max(due + PERIOD, time.monotonic())
                time.sleep(max(0.0, due - time.monotonic()))
                number += 1
                record["tick"], record["time"] = number, due
                start = time.perf_counter_ns()
                publish(record)
                times[name].append(time.perf_counter_ns() - start)
    return {name: np.array(spent) / 1e3 for name, spent in times.items()}


def _measure(folder: Path) -> tuple[dict[str, NDArray[np.float64]], dict[str, int], str]:
    """Return the times (us) of each way, what the reader got by each, and the scheduling."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    ring, record = RingWriter(folder / "ring"), SharedRecord.create(folder / "record", CYCLE)
    with zenoh.open(zenoh.Config.from_json5(_network("listen", endpoint))) as session:
        publisher = session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.DROP)
        reader = subprocess.Popen(
            [sys.executable, "-c", _READER, str(folder), _network("connect", endpoint), KEY],
            stdout=subprocess.PIPE,
            stdin=subprocess.PIPE,
            text=True,
        )
        if not reader.stdout or reader.stdout.readline() != "ready\n":
            raise RuntimeError("the reader does not start")
        while not publisher.matching_status.matching:  # type: ignore[attr-defined]  # its stub says bool
            time.sleep(0.01)
        policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
        try:  # after zenoh's threads have been started: they would inherit it
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
            scheduling = f"SCHED_FIFO {PRIORITY}"
        except PermissionError:
            scheduling = "no real-time priority granted"
        gc.collect()
        gc.disable()
        try:
            times = _paced(
                {
                    "ring": ring,
                    "shared record": record.write,
                    "zenoh put": lambda record: publisher.put(record.tobytes()),
                }
            )
        finally:
            gc.enable()
            os.sched_setscheduler(0, policy, parameters)
        (folder / "over").touch()
        got = json.loads(reader.communicate(timeout=30)[0])
    ring.close()
    record.close()
    return times, got, scheduling


def run() -> list[Row]:
    """Measure; about twenty-five seconds."""
    with tempfile.TemporaryDirectory(dir=MEMORY, prefix="golfbench-benchmark-") as folder:
        times, got, scheduling = _measure(Path(folder))
    published = BLOCK * ROUNDS
    rows = []
    for name, spent in times.items():
        promised = (None, None) if name == "zenoh put" else (PROMISED_MEDIAN, PROMISED_P99)
        p50, p99 = np.percentile(spent, (50, 99))
        worst = f"worst {spent.max():.0f} us"
        note = f"{CYCLE.itemsize} bytes, {published} calls at 1 kHz, {scheduling}"
        rows += [
            Row("shared memory", f"{name}, p50", float(p50), "us", note, at_most=promised[0]),
            Row("shared memory", f"{name}, p99", float(p99), "us", worst, at_most=promised[1]),
        ]
    median = {name: float(np.median(spent)) for name, spent in times.items()}
    return [
        *rows,
        Row("shared memory", "zenoh put, times ring", median["zenoh put"] / median["ring"], "times"),
        Row("shared memory", "lost in the ring", published - got["ring"], "", f"of {published}", at_most=0),
        Row("shared memory", "lost in zenoh", published - got["zenoh"], "", f"of {published}"),
        Row("shared memory", "writes after the record read last", published - got["record"], "", at_most=0),
    ]
