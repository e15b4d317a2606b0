"""The viewer beside a running bench: age of what it shows, its work, and what an hour takes on the disk.

The bench swings all the time, on the plant's own clock unless told otherwise; the viewer writes a Rerun file
and opens no window.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread

import numpy as np
import psutil

from bench.telemetry.recorder import write_swing
from tests.benchmarks.row import Row
from tests.benchmarks.telemetry_age import swing_on
from tests.running_bench import BenchProcess, running_bench, write_configuration

_START = 180.0
"""s in which the viewer starts; the first time it compiles."""
_FIRST = 200_000
"""Bytes of its file when it has shown something of the bench."""
_TOLD = re.compile(
    r"(\d+) batches, (\d+) lost, (\d+) cycles lost in the ring; age at the subscriber p50 ([\d.]+) ms, "
    r"p99 ([\d.]+) ms, in Rerun p50 ([\d.]+) ms, p99 ([\d.]+) ms"
)


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Look for `--minutes`; return ages, work and sizes."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks telemetry_viewer")
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--clock", choices=("wall", "paced"), default="wall")
    options = parser.parse_args(arguments)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        file, saved = write_configuration(folder, "viewer"), folder / "live.rrd"
        bench = stack.enter_context(running_bench(file, clock=options.clock))
        over = Event()
        swinging = Thread(target=swing_on, args=(bench, over))
        stack.callback(swinging.join)
        stack.callback(over.set)
        swinging.start()
        viewer = subprocess.Popen(
            [sys.executable, "-m", "bench", "--config", str(file), "view", "--save", str(saved)],
            stderr=subprocess.PIPE,
            text=True,
        )
        stack.callback(viewer.communicate)
        stack.callback(viewer.kill)
        deadline = time.monotonic() + _START
        while not saved.exists() or saved.stat().st_size < _FIRST:
            if viewer.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError("the viewer does not start")
            time.sleep(0.2)
        processes = {
            "viewer": psutil.Process(viewer.pid),
            "publisher": psutil.Process(bench.pid("publisher")),
        }
        before = {name: _spent(process) for name, process in processes.items()}
        size, begin = saved.stat().st_size, time.monotonic()
        cycles = _cycles(bench, 60.0 * options.minutes)
        seconds = time.monotonic() - begin
        grown = saved.stat().st_size - size
        shares = {name: (_spent(process) - before[name]) / seconds for name, process in processes.items()}
        memory = processes["viewer"].memory_full_info().uss / 2**20
        viewer.terminate()
        _, told = viewer.communicate(timeout=60.0)
        over.set()
        swinging.join()
        records = [path.stat().st_size for path in bench.records]
        write_swing(folder / "all.parquet", cycles, {})
        whole = (folder / "all.parquet").stat().st_size
    match = _TOLD.search(told)
    if match is None:
        raise RuntimeError(f"the viewer told {told!r}")
    batches, lost_batches, lost_cycles, *ages = map(float, match.groups())
    title = f"viewer, {options.minutes:g} min, {options.clock}"
    hour = 3600.0 / seconds / 1e9
    return [
        Row(title, "batches lost", lost_batches, "", f"of {batches:,.0f}", at_most=0),
        Row(title, "cycles lost in the ring", lost_cycles, "", at_most=0),
        *(
            Row(title, f"age, tick to {place}, {share}", age, "ms", "its last minute", at_most=bound)
            for (place, share, bound), age in zip(
                (
                    ("subscriber", "p50", 20.0),
                    ("subscriber", "p99", 100.0),
                    ("Rerun", "p50", None),
                    ("Rerun", "p99", 200.0),
                ),
                ages,
                strict=True,
            )
        ),
        *(Row(title, f"{name}, of a processor", 100.0 * share, "%") for name, share in shares.items()),
        Row(title, "viewer, memory", memory, "MiB", "at the end"),
        Row(title, "recorded swing, Parquet", float(np.mean(records)) / 1e6, "MB", f"of {len(records)}"),
        Row(title, "an hour, Parquet", whole * hour, "GB", "continuous, whatever the robot did"),
        Row(title, "an hour, rrd", grown * hour, "GB", "as `golfbench view --save` writes it"),
    ]


def _spent(process: psutil.Process) -> float:
    spent = process.cpu_times()
    return float(spent.user + spent.system)


def _cycles(bench: BenchProcess, seconds: float) -> np.ndarray:
    """Return all cycles of the next `seconds`."""
    while len(bench.cycles.read()):
        pass
    parts, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        parts.append(bench.cycles.read())
        time.sleep(0.2)
    return np.concatenate(parts)
