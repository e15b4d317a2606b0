"""Recordings of any format: the reader is chosen by the suffix, and what it read is checked."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.errors import BenchError
from bench.golfer.bvh_file import read_bvh
from bench.golfer.c3d_file import read_c3d
from bench.golfer.capture import Capture
from bench.golfer.text_files import read_csv, read_trc

READERS: Mapping[str, Callable[[Path, bytes], Capture]] = {
    ".c3d": read_c3d,
    ".trc": read_trc,
    ".csv": read_csv,
    ".bvh": read_bvh,
}
_MIN_FRAMES, _MAX_FRAMES = 30, 200_000


def read_capture(path: Path) -> Capture:
    """Return the recorded markers in `path`, by its suffix.

    Raises:
        BenchError: the file is missing, of another format, damaged, or no recording of markers.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        action = "Export the recording as C3D; with GEARS: export C3D from GEARS."
        raise BenchError(str(path), f"suffix {path.suffix or 'none'}", f"one of {', '.join(READERS)}", action)
    try:
        content = path.read_bytes()
    except OSError as error:
        action = "Correct the path of the recording."
        raise BenchError(str(path), error.strerror or str(error), "a readable file", action) from None
    capture = reader(path, content)
    points = np.where(np.all(capture.points == 0.0, axis=2, keepdims=True), np.nan, capture.points)
    checked = replace(
        capture,
        points=np.where(np.isfinite(points).all(axis=2, keepdims=True), points, np.nan),
        path=path,
        digest=hashlib.sha256(content).hexdigest(),
    )
    _check(checked)
    return checked


def _check(capture: Capture) -> None:
    """Raise BenchError unless rate and frames are those of a recording."""
    export = "Export the recording again."
    if not _MIN_FRAMES <= len(capture.points) <= _MAX_FRAMES:
        raise capture.error(f"{len(capture.points)} frames", f"{_MIN_FRAMES} to {_MAX_FRAMES} frames", export)
    if not (np.isfinite(capture.rate) and 99.0 <= capture.rate <= 5000.0):
        action = "Record the swing with at least 100 Hz, better 240 Hz."
        raise capture.error(f"{capture.rate:g} frames per second", "100 to 5000 Hz", action)
