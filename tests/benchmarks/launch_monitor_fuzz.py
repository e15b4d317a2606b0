"""Random and mutated JSON at the launch monitor server: nothing escapes, every object is counted once.

    python -m tests.benchmarks launch_monitor_fuzz --fragments 100000 --seed 1

Fragments are shots and heartbeats whole, cut, with bytes turned, with absurd values, nested too deep or too
long, or random bytes, sent over connections that are cut off now and then. The server must keep serving:
after each thousand a proper shot over a new connection is answered and comes out unchanged. Figures that come
out are finite and possible. The server has no way to the robot, so there is no motion to watch for; that its
package cannot reach a driver is checked by its imports.
"""

from __future__ import annotations

import json
import math
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from drivers.base import Launch
from drivers.launch_monitor.open_connect import write_heartbeat, write_shot
from drivers.launch_monitor.record import LaunchRecord
from drivers.launch_monitor.server import LaunchMonitorServer, Link
from drivers.launch_monitor.settings import LaunchMonitorSettings
from tests.benchmarks.row import Row, numbers

PROBE = Launch(65.0, 0.2, 0.01, 300.0, -0.05)
_PROBE_NAME = "probe"
_EVERY = 1000
_ABSURD = (
    b"null",
    b"true",
    b'"NaN"',
    b"NaN",
    b"-Infinity",
    b"1e999",
    b"-1",
    b"0",
    b'""',
    b'"12,5"',
    b"[]",
    b"{}",
    b'"\\ud800"',
    b"9" * 400,
    b"9" * 5000,
    b"[[[[[[[[[[",
    b'{"a":{"b":{"c":1}}}',
    b'"' + b"x" * 3000 + b'"',
    b"\xff\xfe",
    b'"\\u0000"',
)


@dataclass
class Result:
    """Result of a run."""

    fragments: int = 0
    connections: int = 0
    records: int = 0
    """Taken from the server, the probes' not among them."""
    probes: int = 0
    wrong_probes: int = 0
    impossible: list[str] = field(default_factory=list)
    """Records with figures that cannot be."""
    escaped: list[str] = field(default_factory=list)
    """Exceptions in the server's thread."""
    link: Link | None = None
    duration: float = 0.0


def fragment(chance: random.Random) -> bytes:
    """Return one."""
    launch = Launch(*(chance.uniform(-1.0, 1.0) * scale for scale in (100.0, 1.0, 1.0, 900.0, 1.0)))
    whole = write_shot(chance.randrange(10**6), launch, "fuzz")
    if chance.random() < 0.2:
        whole = write_heartbeat(chance.randrange(10**6), "fuzz")
    way = chance.random()
    if way < 0.2:
        return whole
    if way < 0.35:  # cut at either end
        a, b = sorted((chance.randrange(len(whole)), chance.randrange(len(whole))))
        return whole[a:b]
    if way < 0.6:  # one value for an absurd one
        tree = json.loads(whole)
        part = chance.choice([tree, *(node for node in tree.values() if isinstance(node, dict) and node)])
        name = chance.choice(list(part))
        part[name] = "@@@"
        return json.dumps(tree).encode().replace(b'"@@@"', chance.choice(_ABSURD))
    if way < 0.9:  # bytes turned, taken out, put in
        bent = bytearray(whole)
        for _ in range(chance.randrange(1, 6)):
            at = chance.randrange(len(bent))
            match chance.randrange(3):
                case 0:
                    bent[at] ^= 1 << chance.randrange(8)
                case 1:
                    del bent[at : at + chance.randrange(1, 10)]
                case _:
                    bent[at:at] = chance.choice(
                        (b"{", b"}", b'"', b"\\", b"\x00", b"{}", chance.randbytes(4))
                    )
            bent += b"" if bent else b"{"
        return bytes(bent)
    if way < 0.999:
        return chance.randbytes(chance.randrange(200))
    return b'{"a":' * chance.randrange(2, 40) if chance.random() < 0.5 else b'{"' + b"y" * 70_000


def possible(record: LaunchRecord) -> bool:
    """Return whether all figures of `record` are finite and physically possible."""
    figures = (
        record.speed,
        record.launch_angle,
        record.direction,
        record.spin,
        record.spin_axis,
        record.carry,
    )
    bounds = ((0.0, 140.0), (-1.6, 1.6), (-3.2, 3.2), (0.0, 3000.0), (-3.2, 3.2), (0.0, 600.0))
    finite = all(figure is None or math.isfinite(figure) for figure in record.club)
    within = all(v is None or low <= v <= high for v, (low, high) in zip(figures, bounds, strict=True))
    return finite and within


def fuzz(fragments: int, seed: int) -> Result:
    """Send so many fragments to a server of this process."""
    chance, result = random.Random(seed), Result()
    hook, threading.excepthook = threading.excepthook, lambda told: result.escaped.append(repr(told))
    server = LaunchMonitorServer(LaunchMonitorSettings(), port=0)
    server.open()
    start = time.perf_counter()
    connection = None
    try:
        for result.fragments in range(1, fragments + 1):
            if connection is None:
                connection = socket.create_connection(server.address, 10.0)
                result.connections += 1
            try:
                connection.sendall(fragment(chance))
                if chance.random() < 0.5:
                    connection.setblocking(False)
                    with suppress(BlockingIOError):
                        connection.recv(65_536)
                    connection.settimeout(10.0)
                hang_up = chance.random() < 0.02
            except OSError:  # let go by the server
                hang_up = True
            if hang_up:
                connection.close()
                connection = None
            if result.fragments % 100 == 0:
                _take(server, result)
            if result.fragments % _EVERY == 0:
                _probe(server, result)
        _probe(server, result)
    finally:
        if connection is not None:
            connection.close()
        server.close()
        threading.excepthook = hook
    _take(server, result)
    result.duration, result.link = time.perf_counter() - start, server.link()
    return result


def _take(server: LaunchMonitorServer, result: Result) -> None:
    for record in server.take():
        if record.device == _PROBE_NAME:
            error = [abs(a - b) for a, b in zip(record.launch or (math.inf,) * 5, PROBE, strict=True)]
            result.wrong_probes += max(error) > 1e-4 or record.number != result.probes
            continue
        result.records += 1
        if not possible(record):
            result.impossible.append(repr(record))


def _probe(server: LaunchMonitorServer, result: Result) -> None:
    """Send a proper shot over a new connection and wait for its answer."""
    result.probes += 1
    with socket.create_connection(server.address, 10.0) as connection:
        connection.sendall(write_shot(result.probes, PROBE, _PROBE_NAME))
        if b'"Code": 200' not in connection.recv(4096):
            result.wrong_probes += 1
    _take(server, result)


def run(arguments: Sequence[str]) -> list[Row]:
    """Fuzz and return the results."""
    chosen = numbers("launch_monitor_fuzz", arguments, fragments=100_000, seed=1)
    result = fuzz(chosen.fragments, chosen.seed)
    title = f"{chosen.fragments} JSON fragments at the launch monitor server, seed {chosen.seed}"
    return rows_of(result, title)


def rows_of(result: Result, title: str) -> list[Row]:
    """Return the figures of `result`."""
    link = result.link
    if link is None:
        raise ValueError("the run did not end")
    counts = link.counts
    in_no_class = counts.objects - counts.shots - counts.clubs - counts.statuses - counts.refused
    note = ", ".join(f"{name} {count}" for name, count in vars(counts).items())
    untaken = counts.shots - result.records - result.probes - link.lost
    unserved = result.connections + result.probes - link.connections - link.rejected
    return [
        Row(title, "objects in no class", in_no_class, "", note, 0, 0),
        Row(title, "shots that did not come out", untaken, "", f"{result.records} came out", 0, 0),
        Row(title, "connections not served", unserved, "", f"{link.disconnected} disconnected", 0, 0),
        Row(title, "records with impossible figures", len(result.impossible), "", "", at_most=0),
        Row(
            title, "exceptions", len(result.escaped) + link.failures, "", "; ".join(result.escaped[:3]), 0, 0
        ),
        Row(title, "proper shots that came out wrong", result.wrong_probes, "", f"of {result.probes}", 0, 0),
        Row(title, "drivers in reach of the server", len(reached()), "", ", ".join(reached()), 0, 0),
        Row(title, "fragments a second", result.fragments / result.duration, ""),
    ]


def reached() -> list[str]:
    """Return the modules that could move something and that the server's package has imported."""
    modules = "drivers.launch_monitor.server, drivers.launch_monitor.simulator_link"
    code = f"import sys, {modules}; print(*sys.modules)"
    names = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    own = {name for name in names.split() if name.split(".")[0] in ("drivers", "bench", "sim")}
    harmless = {("drivers",), ("drivers", "launch_monitor"), ("drivers", "base")}
    return sorted(name for name in own if tuple(name.split(".")[:2]) not in harmless)
