"""TRC (tab-separated, Motion Analysis) and CSV with columns `time_s, NAME_x, NAME_y, NAME_z`."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from bench.golfer.capture import Array, Capture, damaged, number

_JITTER = 0.2
"""Max deviation of a frame from the regular grid, as a fraction of the frame period."""


def _lines(path: Path, content: bytes) -> list[str]:
    try:
        return content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise damaged(path, f"byte {error.start} is no text", "", "a text file in UTF-8") from None


def read_trc(path: Path, content: bytes) -> Capture:
    """Return the markers of a TRC file.

    Raises:
        BenchError: the header or a row is damaged; the place has the line.
    """
    lines = _lines(path, content)
    if len(lines) < 6 or not lines[0].startswith("PathFileType"):
        raise damaged(path, "no header of TRC", "line 1", "PathFileType and four more lines")
    heads, cells = lines[1].split("\t"), lines[2].split("\t")
    header = dict(zip((head.strip() for head in heads), (cell.strip() for cell in cells), strict=False))
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
        raise damaged(
            path, f"{len(rows)} frames", f"line {rows[-1][0] if rows else 5}", f"{frames:g} as in line 3"
        )
    table = _table(path, [(k, line.rstrip("\r\n").split("\t")[1:]) for k, line in rows], 1 + 3 * len(names))
    return _on_grid(path, names, table, [k for k, _ in rows], header["Units"], rate)


def read_csv(path: Path, content: bytes) -> Capture:
    """Return the markers of a CSV file; the rate is that of its times, the unit is not declared.

    Raises:
        BenchError: the header or a row is damaged; the place has the line.
    """
    rows = [
        (k, row) for k, row in enumerate(csv.reader(io.StringIO("\n".join(_lines(path, content)))), 1) if row
    ]
    header = [cell.strip() for cell in rows[0][1]] if rows else []
    names = [head[:-2] for head in header[1::3]]
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
        raise damaged(
            path, "a time that does not rise", f"line {lines[int(wrong[0]) + 1]}", "rising times (s)"
        )
    step = float(np.median(steps))
    if rate is not None and abs(step * rate - 1.0) > 0.02:
        raise damaged(path, f"{rate:g} Hz, but frames every {step:.6g} s", "line 3", "one frame rate")
    # Times are rounded to decimals, and their mean step is more exact than their median.
    places = np.rint((time - time[0]) / step).astype(int)
    step = float(np.polyfit(places, time, 1)[0])
    off = np.abs((time - time[0]) / step - places)
    if off.max() > _JITTER:
        where = f"line {lines[int(off.argmax())]}"
        raise damaged(
            path, f"time {time[off.argmax()]:g} s beside the frames", where, f"frames every {step:.5f} s"
        )
    points = np.full((places[-1] + 1, len(names), 3), np.nan)
    points[places] = table[:, 1:].reshape(len(table), -1, 3)
    near = round(1.0 / step, 1)
    exact = near if abs(near * step - 1.0) < 1e-3 else 1.0 / step
    return Capture(tuple(names), points, rate or exact, unit, float(time[0]))
