"""Random numbers from a stream that a record carries: the same seed gives the same run, compiled or not."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.base.compiled import compiled


@compiled
def uniform(s: Any) -> float:
    """Return the next random number in (0, 1) of the stream `s.random` (xorshift64, Marsaglia 2003)."""
    z = s.random
    z = z ^ (z << np.uint64(13))
    z = z ^ (z >> np.uint64(7))
    z = z ^ (z << np.uint64(17))
    s.random = z
    return (float(z >> np.uint64(11)) + 0.5) / 9007199254740992.0
