"""C3D files by ezc3d: binary recordings of optical systems (c3d.org)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.errors import BenchError
from bench.golfer.capture import Capture, damaged

_BLOCK = 512


def read_c3d(path: Path, content: bytes) -> Capture:
    """Return the markers of a C3D file; ezc3d reads the file itself.

    Raises:
        BenchError: ezc3d is not installed, or the file is damaged.
    """
    try:
        from ezc3d import c3d
    except ImportError as error:
        action = "Install it: pip install 'golfbench[mocap]'. Or export TRC or CSV."
        raise BenchError(str(path), f"{error}", "the package ezc3d", action) from None
    if len(content) < 2 * _BLOCK or content[1] != 0x50:
        raise damaged(path, "no header of C3D", "first block")
    _check_length(path, content)
    try:
        read = c3d(str(path))
        group = read["parameters"]["POINT"]
        points = np.asarray(read["data"]["points"], dtype=float)
        count = points.shape[1]
        names = [
            str(name).strip() for key in ("LABELS", "LABELS2") if key in group for name in group[key]["value"]
        ]
        unit = group["UNITS"]["value"][0] if group.get("UNITS", {}).get("value") else ""
        rate = float(read["header"]["points"]["frame_rate"])
    except (OSError, RuntimeError, ValueError, KeyError, IndexError, MemoryError) as error:
        raise damaged(path, f"no C3D that can be decoded: {str(error)[:120]}") from None
    if len(names) < count:
        raise damaged(path, f"{len(names)} names for {count} markers", "POINT:LABELS", "a name per marker")
    return Capture(tuple(names[:count]), points[:3].transpose(2, 1, 0), rate, str(unit).strip())


def _check_length(path: Path, content: bytes) -> None:
    """Raise BenchError where the file is shorter than its header states (ezc3d would fill up with zeros)."""
    intel = content[_BLOCK * (content[0] - 1) + 3] == 84 if len(content) > _BLOCK * content[0] else True
    order = "<" if intel else ">"
    words = np.frombuffer(content[:20], dtype=f"{order}u2")
    markers, analogs, first, last = (int(word) for word in words[1:5])
    floats = content[12:16]
    scale = float(np.frombuffer(floats, dtype=f"{order}f4")[0]) if intel else -1.0
    size = 4 if scale < 0.0 else 2
    frames = last - first + 1
    begins = _BLOCK * (int(words[8]) - 1)
    needed = begins + frames * size * (4 * markers + analogs)
    if intel and 0 < first <= last and last != 0xFFFF and len(content) < needed:
        found = f"{len(content)} bytes for {frames} frames of {markers} markers"
        raise damaged(path, found, "data block", f"{needed} bytes")
