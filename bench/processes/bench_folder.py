"""The folder of shared files of a running bench."""

from __future__ import annotations

import re
from pathlib import Path

from bench.errors import BenchError

MEMORY = Path("/dev/shm")  # noqa: S108 - the folder made in it is checked to be ours alone
"""Folder of shared memory, unless systemd provides another one."""

BENCH_ID = r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}"
"""Pattern of a bench id, which is part of network keys and file names."""


def bench_folder(bench_id: str, memory: Path = MEMORY) -> Path:
    """Return the folder in `memory` of bench `bench_id`, which exists while the bench runs.

    A service and a bench started by hand use the same folder, so that they exclude each other.

    Raises:
        BenchError: `bench_id` does not match BENCH_ID.
    """
    if not re.fullmatch(BENCH_ID, bench_id):
        raise BenchError(
            "bench.id", repr(bench_id), "letters, digits, - and _, at most 63", "Give the bench another id."
        )
    return memory / f"golfbench-{bench_id}"
