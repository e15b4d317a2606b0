"""Wake-up latencies by rt-tests' `cyclictest`: what the machine gives a program that does nothing else."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

HISTOGRAM_US = 20_000
"""Latencies from here on are counted together."""


class Latencies(NamedTuple):
    """Wake-up latencies of one run, us; percentiles round up to the resolution."""

    wake_ups: int
    p50: float
    p99: float
    p999: float
    longest: float
    late: int
    """From 1 ms on."""


def run_cyclictest(seconds: int, interval_us: int, priority: int, cpu: int) -> Latencies:
    """Run it for `seconds` with one thread on core `cpu`.

    Raises:
        RuntimeError: it is not installed, not permitted, or says something unknown.
    """
    program = shutil.which("cyclictest")
    if program is None:
        raise RuntimeError("no cyclictest on the PATH; Debian: apt-get install rt-tests")
    options = f"-q -m -a {cpu} -t1 -p {priority} -i {interval_us} -D {seconds} -h {HISTOGRAM_US}"
    answer = subprocess.run(
        [program, *options.split()], capture_output=True, text=True, check=False, cwd=Path("/")
    )
    if answer.returncode:
        raise RuntimeError(f"cyclictest ended with {answer.returncode}: {answer.stderr.strip()}")
    return read_histogram(answer.stdout)


def read_histogram(output: str) -> Latencies:
    """Return the latencies that `output` of cyclictest -h tells.

    Raises:
        RuntimeError: it tells none.
    """
    count: NDArray[np.int64] = np.zeros(HISTOGRAM_US + 1, np.int64)
    longest = 0
    for line in output.splitlines():
        if line.startswith("# Max Latencies:"):
            longest = int(line.split(":")[1])
        elif line.startswith("# Histogram Overflows:"):
            count[HISTOGRAM_US] += int(line.split(":")[1])
        elif line and not line.startswith("#"):
            microseconds, number = map(int, line.split())
            count[microseconds] += number
    total = int(count.sum())
    if not total:
        raise RuntimeError(f"cyclictest counted nothing: {output[:200]!r}")
    # Its buckets are whole microseconds rounded down: a latency lies below the next one.
    ranks = [np.ceil(share * total - 1e-9) for share in (0.5, 0.99, 0.999)]
    p50, p99, p999 = (float(min(edge + 1, longest + 1)) for edge in np.searchsorted(np.cumsum(count), ranks))
    return Latencies(total, p50, p99, p999, float(longest + 1), int(count[1000:].sum()))
