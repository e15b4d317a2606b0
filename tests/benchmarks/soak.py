"""A bench that swings for half an hour in real time: memory of each process, records stored and lost."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.errors import Refused
from bench.telemetry.recorder import read_swing
from tests.benchmarks.row import Row
from tests.running_bench import BenchProcess, running_bench, write_configuration

_BETWEEN_SAMPLES = 10.0
"""s between two looks at the memory."""
_SETTLING = 0.25
"""Share of the time in which memory may still grow: first uses of everything."""


def memory(bench: BenchProcess) -> dict[str, float]:
    """Return the anonymous memory (MiB) of each process of `bench`; files that others map too come and go."""
    pids = {name: child["pid"] for name, child in bench.client.status()["processes"].items()}
    return {name: _anonymous(pid) for name, pid in {"supervisor": bench.process.pid, **pids}.items()}


def _anonymous(pid: int) -> float:
    (line,) = re.findall(r"RssAnon:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    return int(line) / 1024


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Swing for `--minutes`; return growth, and what was lost."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks soak")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--clock", choices=("wall", "paced"), default="paced")
    options = parser.parse_args(arguments)
    samples: list[tuple[float, dict[str, float]]] = []
    stops: list[str] = []
    with TemporaryDirectory() as folder:
        file = write_configuration(Path(folder), "soak")
        with running_bench(file, clock=options.clock) as bench, bench.client.lease("soak"):
            begin = time.monotonic()
            bench.make_ready()
            while (since := time.monotonic() - begin) < 60.0 * options.minutes:
                if not samples or since - samples[-1][0] >= _BETWEEN_SAMPLES:
                    samples.append((since, memory(bench)))
                try:
                    bench.take_address()
                    bench.swing()
                    bench.client.wait_for("READY")
                except (Refused, TimeoutError) as error:
                    stops.append(f"{since:.0f} s: {error}")
                    bench.recover()
            swings = bench.client.status()["swings"]
            loop = bench.client.status()["loop"]
            bench.end()
        records = [read_swing(path)[1] for path in bench.records]
    for stop in stops:
        print(stop)
    title = f"soak of {options.minutes:g} min, {options.clock}"
    whole = [r for r in records if r["kind"] == "swing"]
    rows = [
        Row(title, "swings", swings, "", f"{len(stops)} stops by the bench itself"),
        Row(title, "swings without a record", swings - len(whole), "", at_most=0),
        Row(title, "records lost on the way", sum(r["lost_records"] for r in records), "", at_most=0),
        Row(title, "ticks skipped", loop["skipped"], "ticks"),
    ]
    settled = [sample for sample in samples if sample[0] >= _SETTLING * samples[-1][0]]
    for name in settled[0][1]:
        times = np.array([since for since, found in settled if name in found])
        sizes = np.array([found[name] for _, found in settled if name in found])
        slope = 3600.0 * np.polyfit(times, sizes, 1)[0] if len(times) > 2 else np.nan
        note = f"{sizes[0]:.1f} MiB at {times[0] / 60:.0f} min, {sizes[-1]:.1f} at the end"
        rows.append(
            Row(title, f"growth of {name}", float(sizes[-1] - sizes[0]), "MiB", f"{note}; {slope:+.1f} MiB/h")
        )
    return rows
