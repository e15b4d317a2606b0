"""Recordings of any format, checked: TRC, CSV, BVH (joints of a skeleton, no club), C3D by ezc3d."""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from bench.base.errors import BenchError, load_extra
from bench.base.from_toml import encoding_of
from bench.golfer.roles import Array, Capture, damaged, number

_JITTER = 0.2
"""Max deviation of a frame from the regular grid, as a fraction of the frame period."""
_MIN_FRAMES, _MAX_FRAMES = 30, 200_000


def _lines(content: bytes) -> list[str]:
    """Return the lines; a byte that is no UTF-8 is one of a name or path, as programs of Windows write it."""
    return content.decode(encoding_of(content), errors="replace").splitlines()


def read_trc(path: Path, content: bytes) -> Capture:
    """Return the markers of a TRC file.

    Raises:
        BenchError: the header or a row is damaged; the place has the line.
    """
    lines = _lines(content)
    if len(lines) < 6 or not lines[0].startswith("PathFileType"):
        raise damaged(path, "no header of TRC", "line 1", "PathFileType and four more lines")
    header = _trc_header(lines[1], lines[2])
    missing = [key for key in ("DataRate", "NumFrames", "NumMarkers", "Units") if not header.get(key)]
    if missing:
        raise damaged(path, f"no value of {missing[0]}", "line 3")
    rate, frames, count = (
        number(path, header[key], "line 3") for key in ("DataRate", "NumFrames", "NumMarkers")
    )
    names = [name.strip() for name in lines[3].split("\t")[2:] if name.strip()]
    if len(names) != count:
        raise damaged(path, f"{len(names)} markers", "line 4", f"{count:g} as in line 3")
    rows = [(k, line) for k, line in enumerate(lines[4:], 5) if line.strip()][1:]  # the axes come first
    if len(rows) != frames:
        last = rows[-1][0] if rows else 5
        raise damaged(path, f"{len(rows)} frames", f"line {last}", f"{frames:g} as in line 3")
    table = _table(path, [(k, line.rstrip("\r\n").split("\t")[1:]) for k, line in rows], 1 + 3 * len(names))
    return _on_grid(path, names, table, [k for k, _ in rows], header["Units"], rate)


def _trc_header(names: str, values: str) -> dict[str, str]:
    """Return the values by name; older files separate them by several tabs and blanks."""
    if len(names.split()) == len(values.split()):
        return dict(zip(names.split(), values.split(), strict=True))
    heads, cells = names.split("\t"), values.split("\t")
    return dict(zip((head.strip() for head in heads), (cell.strip() for cell in cells), strict=False))


def read_csv(path: Path, content: bytes) -> Capture:
    """Return the markers of a CSV file; the rate is that of its times, the unit is not declared.

    Raises:
        BenchError: the header or a row is damaged; the place has the line.
    """
    reader, rows = csv.reader(io.StringIO("\n".join(_lines(content)))), list[tuple[int, list[str]]]()
    try:
        rows += ((k, row) for k, row in enumerate(reader, 1) if row)
    except csv.Error as error:
        raise damaged(path, str(error), f"line {len(rows) + 1}", "a row without quotes") from None
    header = [cell.strip() for cell in rows[0][1]] if rows else []
    names = [head[:-2] for head in header[1::3]]
    if len(header) == 1 and ";" in header[0]:
        raise damaged(path, "cells separated by ;", "line 1", "cells separated by commas, points in numbers")
    wanted = ["time_s", *(f"{name}_{axis}" for name in names for axis in "xyz")]
    if not names or header != wanted:
        found = next((a for a, b in zip(header, wanted, strict=False) if a != b), f"{len(header)} columns")
        raise damaged(path, found[:40] or "no name", "line 1", "time_s,NAME_x,NAME_y,NAME_z and so on")
    table = _table(path, rows[1:], len(header))
    return _on_grid(path, names, table, [k for k, _ in rows[1:]], "", None)


def _table(path: Path, rows: list[tuple[int, list[str]]], columns: int) -> Array:
    """Return the numbers of `rows`, NaN in empty cells and where a row ends early with empty ones."""
    table = np.full((len(rows), columns), np.nan)
    for row, (line, cells) in enumerate(rows):
        while len(cells) > columns and not cells[-1].strip():
            cells.pop()
        if len(cells) > columns or len(cells) < columns - 3 * (columns > 4):
            raise damaged(path, f"{len(cells)} cells", f"line {line}", f"{columns} cells")
        for column, cell in enumerate(cells):
            table[row, column] = number(path, cell, f"line {line}, column {column + 1}")
    return table


def _on_grid(
    path: Path, names: list[str], table: Array, lines: list[int], unit: str, rate: float | None
) -> Capture:
    """Return `table` (time and positions) on a regular grid; left-out frames are gaps."""
    if len(table) < 3:
        raise damaged(path, f"{len(table)} frames", "", "at least 3 frames")
    time = table[:, 0]
    steps = np.diff(time)
    wrong = np.flatnonzero(~(steps > 0.0))
    if len(wrong):
        where = f"line {lines[int(wrong[0]) + 1]}"
        raise damaged(path, "a time that does not rise", where, "rising times (s)")
    # Times are rounded to decimals: steps of 8 and 9 ms are 120 Hz. Their mean is more exact than one.
    middle = float(np.sort(steps)[len(steps) // 2])
    step = float(np.mean(steps[np.abs(steps - middle) < 0.5 * middle]))
    places = np.rint((time - time[0]) / step).astype(int)
    step = float(np.polyfit(places, time, 1)[0])
    if rate is not None and abs(step * rate - 1.0) > 0.02:
        raise damaged(path, f"{rate:g} Hz, but frames every {step:.6g} s", "line 3", "one frame rate")
    off = np.abs((time - time[0]) / step - places)
    if off.max() > _JITTER:
        found, where = f"time {time[off.argmax()]:g} s off the frames", f"line {lines[int(off.argmax())]}"
        raise damaged(path, found, where, f"frames every {step:.5f} s")
    if places[-1] >= _MAX_FRAMES:
        found, where = f"{steps.max():.6g} s after the frame before", f"line {lines[int(steps.argmax()) + 1]}"
        raise damaged(path, found, where, f"below {_MAX_FRAMES} frames")
    points = np.full((places[-1] + 1, len(names), 3), np.nan)
    points[places] = table[:, 1:].reshape(len(table), -1, 3)
    near = round(1.0 / step, 1)
    exact = near if abs(near * step - 1.0) < 1e-3 else 1.0 / step
    return Capture(tuple(names), points, rate or exact, unit, float(time[0]))


@dataclass
class _Joint:
    """A joint of the skeleton."""

    name: str
    parent: int
    offset: Array = field(default_factory=lambda: np.zeros(3))
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path, content: bytes) -> Capture:
    """Return the joint positions of a BVH file; its unit is not declared.

    Raises:
        BenchError: the skeleton or a frame is damaged; the place has the line.
    """
    lines = _lines(content)
    motion = next((k for k, line in enumerate(lines) if line.strip() == "MOTION"), -1)
    if motion < 0 or not lines[0].strip().startswith("HIERARCHY") or len(lines) < motion + 4:
        raise damaged(path, "no HIERARCHY with MOTION")
    joints = _skeleton(path, lines[1:motion])
    period = number(path, lines[motion + 2].partition(":")[2], f"line {motion + 3}")
    frames = number(path, lines[motion + 1].partition(":")[2], f"line {motion + 2}")
    rows = [(k, line.split()) for k, line in enumerate(lines[motion + 3 :], motion + 4) if line.strip()]
    width = sum(len(joint.channels) for joint in joints)
    for line, cells in rows:
        if len(cells) != width:
            raise damaged(path, f"{len(cells)} values", f"line {line}", f"{width} values")
    if len(rows) != frames:
        raise damaged(path, f"{len(rows)} frames", f"line {motion + 2}", f"{frames:g} frames")
    if not period > 0.0:
        raise damaged(path, f"frame time {period:g}", f"line {motion + 3}", "Frame Time: a time above 0 s")
    table = np.array([[number(path, cell, f"line {line}") for cell in cells] for line, cells in rows])
    rate = round(1.0 / period, 1)
    names = tuple(joint.name for joint in joints if joint.name)
    return Capture(names, _positions(joints, table), rate)


_CHANNEL = re.compile("[xyz](position|rotation)", re.IGNORECASE)


def _skeleton(path: Path, lines: list[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    open_: list[int] = []
    for k, line in enumerate(lines, 2):
        words = line.split()
        if words[:1] in (["ROOT"], ["JOINT"]) and len(words) > 1:
            joints.append(_Joint(words[1], open_[-1] if open_ else -1))
        elif words[:1] == ["{"]:
            open_.append(len(joints) - 1)
        elif words[:1] == ["}"] and open_:
            open_.pop()
        elif words[:1] == ["End"]:
            joints.append(_Joint("", open_[-1] if open_ else -1))
        elif words[:1] == ["OFFSET"] and joints and len(words) == 4:
            joints[-1].offset = np.array([number(path, word, f"line {k}") for word in words[1:]])
        elif words[:1] == ["CHANNELS"] and joints and all(map(_CHANNEL.fullmatch, words[2:])):
            joints[-1].channels = words[2:]
        elif words:
            raise damaged(path, line.strip()[:40], f"line {k}", "a joint of a skeleton")
    return joints


def _positions(joints: list[_Joint], table: Array) -> Array:
    """Return the positions (frames, named joints, 3) by the angles (deg) and offsets in `table`."""
    count, column = len(table), 0
    turns: list[Rotation] = []
    places: list[Array] = []
    for joint in joints:
        move, turn = np.tile(joint.offset, (count, 1)), Rotation.identity(count)
        for channel in joint.channels:
            values, axis = table[:, column], channel[0].lower()
            column += 1
            if channel.lower().endswith("position"):
                k = "xyz".index(axis)
                move[:, k] = values + (0.0 if joint.parent < 0 else joint.offset[k])
            else:
                turn = turn * Rotation.from_euler(axis, values[:, None], degrees=True)
        if joint.parent >= 0:
            above = turns[joint.parent]
            move, turn = places[joint.parent] + above.apply(move), above * turn
        turns.append(turn)
        places.append(move)
    return np.stack([place for joint, place in zip(joints, places, strict=True) if joint.name], axis=1)


_BLOCK = 512


def read_c3d(path: Path, content: bytes) -> Capture:
    """Return the markers of a C3D file; ezc3d reads the file itself.

    Raises:
        BenchError: ezc3d is not installed, or the file is damaged.
    """
    ezc3d = load_extra("ezc3d", "mocap", str(path), ", or export TRC or CSV")
    if len(content) < 2 * _BLOCK or content[1] != 0x50:
        raise damaged(path, "no header of C3D", "first block")
    _check_length(path, content)
    try:
        read = ezc3d.c3d(str(path))
        group = read["parameters"]["POINT"]
        points = np.asarray(read["data"]["points"], dtype=float)
        count = points.shape[1]
        labels = [group[key]["value"] for key in ("LABELS", "LABELS2") if key in group]
        names = [str(name).strip() for some in labels for name in some]
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


READERS: Mapping[str, Callable[[Path, bytes], Capture]] = {
    ".c3d": read_c3d,
    ".trc": read_trc,
    ".csv": read_csv,
    ".bvh": read_bvh,
}


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
