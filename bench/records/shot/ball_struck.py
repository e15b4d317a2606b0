"""Whether a swing struck a ball, by the sensor at the tee."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Phase

Cycles = np.ndarray[Any, Any]


def ball_struck(cycles: Cycles) -> bool:
    """Return whether a ball was on the tee until the head arrived."""
    swung = np.isin(cycles["phase"], (Phase.DOWNSWING, Phase.COMMITTED))
    after = cycles["phase"] == Phase.FOLLOW_THROUGH
    if not swung.any() or not after.any():
        return False
    return bool(cycles["ball_present"][swung][0] and not cycles["ball_present"][after][-1])
