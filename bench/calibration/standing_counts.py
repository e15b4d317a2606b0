"""Encoder counts of a running bench while the robot is locked at its mechanical reference."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from bench.errors import Refused
from bench.telemetry.ring import RingReader
from drivers.base import JOINTS

_LEAST = 20
"""Min number of records: fewer mean that the loop hardly runs."""

_STILL = 8
"""Max noise of a locked joint, counts."""


def standing_counts(ring: Path, counts_per_revolution: int, seconds: float = 0.5) -> tuple[int, int, int]:
    """Watch the cycles in `ring` for `seconds` and return the median count of each joint.

    Raises:
        NoRing: no bench runs here.
        Refused: its loop stands still, an encoder gives no valid reading, or a joint moves.
    """
    reader = RingReader(ring)
    try:
        reader.read()
        time.sleep(seconds)
        cycles = reader.read(limit=100_000)
    finally:
        reader.close()
    place = "calibrate encoders --from-pose"
    if len(cycles) < _LEAST:
        raise Refused(
            place, f"{len(cycles)} cycles in {seconds:g} s", "a running loop", "Start `golfbench run` again."
        )
    middles = []
    for joint, name in enumerate(JOINTS):
        if not cycles["encoder_valid"][:, joint].all():
            raise Refused(
                place,
                f"{name}: invalid readings",
                "valid readings",
                f"Check the cable of the {name} encoder.",
            )
        counts = cycles["encoder_count"][:, joint]
        # Around the last one, so that a count at the range's end does not split.
        half = counts_per_revolution // 2
        around = (counts - counts[-1] + half) % counts_per_revolution - half
        spread = int(np.ptp(around))
        if spread > _STILL:
            found = f"{name}: it moved by {spread} counts in {seconds:g} s"
            raise Refused(place, found, f"{_STILL} at most", "Lock the robot at its mechanical reference.")
        middles.append(int(counts[-1] + round(float(np.median(around)))) % counts_per_revolution)
    a, b, c = middles
    return a, b, c
