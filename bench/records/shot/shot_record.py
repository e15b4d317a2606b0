"""A shot with all that was recorded of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.records.shot.shot import Shot, ShotStatus
from sim.flight import Flight


@dataclass(frozen=True)
class ShotRecord:
    """A shot, its cycles (n records of CYCLE) and, when the ball flew, its flight."""

    shot: Shot
    cycles: np.ndarray[Any, Any] = field(repr=False, compare=False)
    flight: Flight | None = None

    @property
    def valid(self) -> bool:
        """The shot counts in comparisons."""
        return self.shot.status is ShotStatus.VALID
