"""Transfer of a learned correction from the supervisor into the running loop.

The supervisor orders weights; the loop applies them between swings and reports the tick since which they are
active. A correction changes tables of the following swings: reference and feed-forward up to the impact. All
limits of a swing apply to the corrected one as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.swing.correction import Basis
from bench.swing.correction_terms import MAX_WEIGHTS
from bench.swing.profile import Profile
from drivers.base.shared_memory import SharedRecord

CORRECTION_FILE, CORRECTED_FILE = "correction", "corrected"

CORRECTION = np.dtype([("number", "i8"), ("size", "i8"), ("weights", "f8", (MAX_WEIGHTS,))], align=True)
"""Order of a correction with `size` weights, 0 for the profile as designed; a new `number` is a new order."""

CORRECTED = np.dtype([("asked", "i8"), ("tick", "i8"), ("order", CORRECTION)], align=True)
"""`asked` is the number of the last order processed, `order` the one active since `tick`."""


def pack_correction(number: int, weights: Sequence[float]) -> np.ndarray[Any, Any]:
    """Return order `number` (one-element array of CORRECTION)."""
    order = np.zeros(1, CORRECTION)
    order["number"], order["size"] = number, len(weights)
    order["weights"][0, : len(weights)] = weights
    return order


def weights_of(order: np.ndarray[Any, Any]) -> list[float]:
    """Return the weights in `order` (one element of CORRECTION)."""
    weights: list[float] = order["weights"].reshape(-1)[: int(order["size"].reshape(-1)[0])].tolist()
    return weights


class CorrectionReader:
    """The loop's side of the transfer."""

    def __init__(self, folder: Path, profile: Profile, basis: Basis) -> None:
        """Open the bench's files for corrections of `profile` with weights of `basis`.

        Raises:
            SharedMemoryError: the supervisor has not created them.
        """
        self._profile, self._basis = profile, basis
        self._orders = SharedRecord.open(folder / CORRECTION_FILE, CORRECTION)
        self._active = SharedRecord.create(folder / CORRECTED_FILE, CORRECTED)
        self._order, self._answer = np.zeros(1, CORRECTION), np.zeros(1, CORRECTED)
        self._version = self._orders.slots.head
        self._active.write(self._answer)

    @property
    def is_ordered(self) -> bool:
        """Whether there is an order that was not taken yet."""
        return self._orders.slots.head != self._version

    def take(self, tick: int, *, resting: bool) -> Profile | None:
        """Return the profile to swing from `tick` on if a new one was ordered, else None.

        An order that arrives while the robot is not resting, or for another profile, only updates `asked`
        and is dropped.
        """
        if not self.is_ordered:
            return None
        self._version = self._orders.read(self._order)
        self._answer["asked"] = self._order["number"]
        taken = None
        weights = weights_of(self._order)
        if resting and len(weights) in (0, self._basis.size):
            taken = self._profile
            if weights:
                taken = self._basis.corrected(taken, weights)
            self._answer["tick"], self._answer["order"] = tick, self._order
        self._active.write(self._answer)
        return taken

    def close(self) -> None:
        """Unmap the files."""
        self._orders.close()
        self._active.close()
