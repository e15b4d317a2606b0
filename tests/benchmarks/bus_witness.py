"""Somebody who sees every frame of a local bus: `python -m tests.benchmarks.bus_witness FOLDER PRIORITY`.

Counts between two frames of MARK, prints what it counted as one line of JSON, and ends.
"""

from __future__ import annotations

import gc
import json
import os
import sys
from collections import Counter
from contextlib import suppress
from functools import lru_cache

import numpy as np

from drivers.can_bus import FRAME, LocalSocketBus
from tests.benchmarks.can_bits import bits_of

MARK = 0x7EF
SYNC, COMMAND, POSITIONS = 0x80, 0x20A, (0x281, 0x282, 0x283)

_bits_of = lru_cache(maxsize=200_000)(bits_of)


class Witness(LocalSocketBus):
    """Takes frames with their stamps."""

    def stamped(self) -> tuple[int, int, bytes]:
        """Wait for a frame; return when it was sent (ns), its identifier and its data."""
        while (whole := self._next(1.0)) is None:
            pass
        identifier, length, data = FRAME.unpack(whole[: FRAME.size])
        return int.from_bytes(whole[FRAME.size :], "big"), identifier, data[:length]


def count(bus: Witness) -> dict[str, object]:
    """Count from one MARK to the next."""
    while bus.stamped()[1] != MARK:
        pass
    frames: Counter[int] = Counter()
    thirds: list[int] = []
    bits = seen = 0
    begin = synced = 0
    while True:
        time, identifier, data = bus.stamped()
        begin = begin or time
        if identifier == MARK:
            break
        frames[identifier] += 1
        bits += _bits_of(identifier, data)
        if identifier == SYNC:
            synced, seen = time, 0
        elif identifier in POSITIONS:
            seen += 1
            if seen == len(POSITIONS):
                thirds.append(time - synced)
    p50, p99, longest = (1e-3 * np.quantile(thirds, [0.5, 0.99, 1.0])).tolist() if thirds else (np.nan,) * 3
    return {
        "frames": dict(frames),
        "bits": bits,
        "seconds": 1e-9 * (time - begin),
        "third": {"p50_us": p50, "p99_us": p99, "max_us": longest, "count": len(thirds)},
    }


def main() -> None:
    """Join, count, tell."""
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(sys.argv[2])))
    gc.disable()
    with Witness(sys.argv[1]) as bus:
        print("here", flush=True)
        print(json.dumps(count(bus)), flush=True)


if __name__ == "__main__":
    main()
