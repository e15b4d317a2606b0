"""Recorded marker positions, as a file contains them, and the readers by suffix."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError

Array = NDArray[np.float64]

_MIN_FRAMES = 30
_MAX_FRAMES = 200_000


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
        self, found: str, expected: str, cure: str, frame: int | None = None, marker: str = ""
    ) -> BenchError:
        """Return the refusal of this file, with the 0-based `frame` and the `marker` in its place."""
        place = str(self.path)
        if frame is not None:
            place += f", frame {frame + 1} ({self.start + frame / self.rate:.3f} s)"
        return BenchError(place + (f", marker {marker}" if marker else ""), found, expected, cure)


Reader = Callable[[Path, bytes], Capture]


def _readers() -> Mapping[str, Reader]:
    from bench.golfer.bvh_file import read_bvh
    from bench.golfer.c3d_file import read_c3d
    from bench.golfer.text_files import read_csv, read_trc

    return {".c3d": read_c3d, ".trc": read_trc, ".csv": read_csv, ".bvh": read_bvh}


def read_capture(path: Path) -> Capture:
    """Return the recorded markers in `path`, by its suffix.

    Raises:
        BenchError: the file is missing, of another format, damaged, or no recording of markers.
    """
    readers = _readers()
    if path.suffix.lower() not in readers:
        cure = "Export the recording as C3D; with GEARS: export C3D from GEARS."
        raise BenchError(str(path), f"suffix {path.suffix or 'none'}", "one of .c3d, .trc, .csv, .bvh", cure)
    try:
        content = path.read_bytes()
    except OSError as error:
        cure = "Correct the path of the recording."
        raise BenchError(str(path), error.strerror or str(error), "a readable file", cure) from None
    capture = readers[path.suffix.lower()](path, content)
    points = np.where(np.all(capture.points == 0.0, axis=2, keepdims=True), np.nan, capture.points)
    checked = Capture(
        capture.names,
        np.where(np.isfinite(points).all(axis=2, keepdims=True), points, np.nan),
        capture.rate,
        capture.unit,
        capture.start,
        path,
        hashlib.sha256(content).hexdigest(),
    )
    _check(checked)
    return checked


def _check(capture: Capture) -> None:
    """Raise BenchError unless rate and frames are those of a recording."""
    export = "Export the recording again."
    if not _MIN_FRAMES <= len(capture.points) <= _MAX_FRAMES:
        raise capture.error(f"{len(capture.points)} frames", f"{_MIN_FRAMES} to {_MAX_FRAMES} frames", export)
    if not (np.isfinite(capture.rate) and 99.0 <= capture.rate <= 5000.0):
        cure = "Record the swing with at least 100 Hz, better 240 Hz."
        raise capture.error(f"{capture.rate:g} frames per second", "100 to 5000 Hz", cure)


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
