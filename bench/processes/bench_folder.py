"""Where a running bench keeps what its processes share."""

from __future__ import annotations

import re
from pathlib import Path

from bench.errors import BenchError

MEMORY = Path("/dev/shm")  # noqa: S108 - the folder made in it is checked to be ours alone
"""Where shared memory has its files unless systemd gives a place."""

BENCH_ID = r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}"
"""What a bench may be called: its id is part of addresses and of files' names."""


def bench_folder(bench_id: str, memory: Path = MEMORY) -> Path:
    """Return the folder in `memory` of bench `bench_id`, which exists while the bench is run.

    It is at the same place for a service and for a bench started by hand: they must meet.

    Raises:
        BenchError: `bench_id` is not of the form BENCH_ID.
    """
    if not re.fullmatch(BENCH_ID, bench_id):
        raise BenchError(
            "bench.id", repr(bench_id), "letters, digits, - and _, at most 63", "Give the bench another id."
        )
    return memory / f"golfbench-{bench_id}"
