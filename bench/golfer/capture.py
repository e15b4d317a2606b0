"""Recorded marker positions, as a file contains them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Capture:
    """Marker positions over time in the unit and axes of the file."""

    names: tuple[str, ...]
    """Names of the markers."""
    points: Array
    """Positions (frames, markers, 3), NaN where a marker is missing."""
    rate: float
    """Frame rate (Hz)."""
    unit: str = ""
    """Unit that the file declares, empty without one."""
    start: float = 0.0
    """Time of the first frame (s)."""
    path: Path = field(default_factory=Path)
    """Source file."""
    digest: str = ""
    """SHA-256 of the source file."""

    def error(
        self, found: str, expected: str, action: str, frame: int | None = None, marker: str = ""
    ) -> BenchError:
        """Return the refusal of this file, with the 0-based `frame` and the `marker` in its place."""
        place = str(self.path)
        if frame is not None:
            place += f", frame {frame + 1} ({self.start + frame / self.rate:.3f} s)"
        return BenchError(place + (f", marker {marker}" if marker else ""), found, expected, action)


def damaged(path: Path, found: str, where: str = "", expected: str = "a complete recording") -> BenchError:
    """Return the error of a file that cannot be decoded; `where` is a line or part of it."""
    place = f"{path}, {where}" if where else str(path)
    return BenchError(place, found, expected, "Export or copy the file again.")


def number(path: Path, text: str, where: str) -> float:
    """Return the number in a cell of a text file, NaN where it is empty.

    Raises:
        BenchError: the cell is no number.
    """
    try:
        return float(text) if text.strip() else float("nan")
    except ValueError:
        raise damaged(path, repr(text.strip()[:40]), where, "a number or an empty cell") from None
