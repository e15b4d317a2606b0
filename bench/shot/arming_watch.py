"""Detection of the bench's arming in the ring."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.lifecycle import State


class ArmingWatch:
    """Follows the state of the bench; for one run of its loop."""

    def __init__(self) -> None:
        self._armed = False

    def take(self, cycles: np.ndarray[Any, Any]) -> bool:
        """Return whether the bench was armed within `cycles`, which continue those of the last call."""
        if not len(cycles):
            return False
        armed = cycles["state"] == State.ARMED
        before = np.concatenate([[self._armed], armed[:-1]])
        self._armed = bool(armed[-1])
        return bool(np.any(armed & ~before))
