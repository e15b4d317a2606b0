"""Damaged recordings are refused, each by name."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.golfer.golfer_file import ImportOptions
from bench.golfer.recording import read_capture
from tests.bench.golfer.synthetic import BALL, MAP, Array, Synthetic, write
from tests.bench.golfer.test_synthetic_golfers import imported

RATE = 240
AT_BALL = round(BALL * RATE)
Change = Callable[[list[str], Array], Array | None]
Edit = Callable[[list[str]], object]


@cache
def _recording() -> tuple[tuple[str, ...], Array]:
    names, points = Synthetic().recording()
    return tuple(names), points


def _of(names: list[str], *roles: str) -> list[int]:
    return [k for k, name in enumerate(names) if name[:-1] in roles]


def _missing(role: str, first: int, end: int) -> Change:
    def change(names: list[str], points: Array) -> Array | None:
        points[first:end, _of(names, role)] = np.nan
        return None

    return change


def _swapped(one: str, other: str, first: int = 0) -> Change:
    def change(names: list[str], points: Array) -> Array | None:
        a, b = _of(names, one), _of(names, other)
        points[first:, a + b] = points[first:, b + a]
        return None

    return change


def _cut(first: int, end: int) -> Change:
    return lambda _, points: points[first:end]


def _times(factor: float) -> Change:
    return lambda _, points: points * factor


def _jump(names: list[str], points: Array) -> Array | None:
    points[280, _of(names, "LWRI")] += [0.0, 0.06, 0.0]
    return None


def _step(names: list[str], points: Array) -> Array | None:
    points[290:, _of(names, "RSHO")] += [0.08, 0.0, 0.0]
    return None


def _slow(_: list[str], points: Array) -> Array | None:
    return np.repeat(points[:150], 3, axis=0)


def _half_swing(_: list[str], points: Array) -> Array | None:
    there = points[60:130]
    return np.concatenate([points[:130], there[::-1], np.repeat(there[:1], 60, axis=0)])


def _standing(_: list[str], points: Array) -> Array | None:
    return np.repeat(points[:1], 300, axis=0)


DAMAGED: dict[str, tuple[Change, str, str]] = {
    "cut 5 ms before the ball": (_cut(0, AT_BALL - 1), "no impact", "HEAD"),
    "cut 50 ms before the ball": (_cut(0, AT_BALL - 12), "no impact", "HEAD"),
    "cut at the top": (_cut(0, 250), "no impact", "HEAD"),
    "begins after the ball": (_cut(AT_BALL + 5, 385), "no swing", ""),
    "head lost at the ball": (_missing("HEAD", AT_BALL - 2, AT_BALL + 2), "at the ball", "HEAD1"),
    "head lost 15 ms before the ball": (_missing("HEAD", AT_BALL - 5, AT_BALL - 3), "at the ball", "HEAD1"),
    "wrist lost at the ball": (_missing("LWRI", AT_BALL - 3, AT_BALL + 1), "at the ball", "LWRI1"),
    "head lost from the downswing on": (_missing("HEAD", AT_BALL - 20, 385), "marker lost", "HEAD1"),
    "gap of 50 ms in the downswing": (_missing("LWRI", 280, 292), "gap of 50 ms", "LWRI1"),
    "gap of 46 ms of a shoulder": (_missing("RSHO", 270, 281), "gap of 46 ms", "RSHO1"),
    "shoulders swapped": (_swapped("LSHO", "RSHO"), "sides swapped", "RWRI1"),
    "wrists swapped": (_swapped("LWRI", "RWRI"), "sides swapped", "LWRI1"),
    "shoulders swapped in the downswing": (_swapped("LSHO", "RSHO", 285), "exchanged", "SHO1"),
    "wrists swapped in the downswing": (_swapped("LWRI", "RWRI", 285), "exchanged", "LWRI1"),
    "a wrist jumps to and fro": (_jump, "a jump of", "LWRI1"),
    "a shoulder jumps and stays": (_step, "a jump of", "RSHO1"),
    "numbers of another unit": (_times(10.0), "sizes of a person", "LSHO1 to LWRI1"),
    "numbers in inches": (_times(1 / 0.0254), "sizes of a person", "LSHO1 to LWRI1"),
    "a child's size": (_times(0.5), "sizes of a person", "LSHO1 to LWRI1"),
    "a slow backswing": (_slow, "no ", ""),
    "half a backswing and back": (_half_swing, "no ", ""),
    "standing still": (_standing, "no impact", "HEAD"),
    "grip where the head is": (_swapped("GRIP", "HEAD"), "head further away", "HEAD1"),
    "head always missing": (_missing("HEAD", 0, 385), "less than 12 frames", "HEAD1"),
}


@pytest.mark.parametrize(("change", "found", "marker"), DAMAGED.values(), ids=DAMAGED)
def test_import_damaged_recording_names_marker(
    change: Change, found: str, marker: str, tmp_path: Path
) -> None:
    names, points = list(_recording()[0]), _recording()[1].copy()
    changed = change(names, points)
    path = write(tmp_path / "damaged.csv", names, points if changed is None else changed, RATE)
    with pytest.raises(BenchError) as refused:
        imported(path)
    assert str(path) in refused.value.location
    assert found in f"{refused.value.found} {refused.value.expected}"
    assert marker in refused.value.location
    assert len(refused.value.action.split()) > 3


def _written(path: Path, change: Edit | None = None) -> Path:
    """Write the recording to `path`, its lines changed in place by `change`."""
    names, points = _recording()
    write(path, list(names), points, RATE)
    if change is not None:
        lines = path.read_text().splitlines()
        change(lines)
        path.write_text("\n".join(lines))
    return path


def _csv(tmp_path: Path, change: Edit | None = None) -> Path:
    return _written(tmp_path / "swing.csv", change)


def _refusal(path: Path) -> BenchError:
    with pytest.raises(BenchError) as refused:
        read_capture(path)
    return refused.value


def test_read_capture_60_hz_refused(tmp_path: Path) -> None:
    names, points = _recording()
    refusal = _refusal(write(tmp_path / "slow.csv", list(names), points[::4], 60))
    assert "60 frames per second" in refusal.found


def _text(lines: list[str]) -> None:
    cells = lines[99].split(",")
    lines[99] = ",".join([cells[0], "zero", *cells[2:]])


def _header(lines: list[str]) -> None:
    lines[0] = "time,LSHO1_x"


def _cut_row(lines: list[str]) -> None:
    lines[200:] = ["0.829167,0.1,0.2,0.3"]


def _short_row(lines: list[str]) -> None:
    lines[49] = "0.1"


def _fall(lines: list[str]) -> None:
    lines[10], lines[11] = lines[11], lines[10]


def _far_off(lines: list[str]) -> None:
    lines[-1] = f"1764350000{lines[-1][lines[-1].index(',') :]}"


def _open_quote(lines: list[str]) -> None:
    lines[5] = '"' + lines[5]


@pytest.mark.parametrize(
    ("change", "location", "found"),
    [
        (_text, "line 100, column 2", "'zero'"),
        (_header, "line 1", "time"),
        (_cut_row, "", "4 cells"),
        (_short_row, "line 50", "1 cells"),
        (_fall, "line 12", "does not rise"),
        (_far_off, "line 386", "1.76435e+09 s after the frame before"),
        (_open_quote, "line 6", ""),
    ],
)
def test_read_capture_damaged_csv_reports_line(
    change: Edit, location: str, found: str, tmp_path: Path
) -> None:
    refusal = _refusal(_csv(tmp_path, change))
    assert location in refusal.location
    assert found in refusal.found


def test_read_capture_missing_rows_become_gaps(tmp_path: Path) -> None:
    capture = read_capture(_csv(tmp_path, lambda lines: lines.__delitem__(slice(150, 153))))
    assert capture.rate == pytest.approx(RATE)
    assert np.isnan(capture.points[149:152]).all()
    assert len(capture.points) == 385


@pytest.mark.parametrize(("suffix", "column", "separator"), [(".csv", 0, ","), (".trc", 1, "\t")])
def test_read_capture_times_in_ms_give_all_frames(
    suffix: str, column: int, separator: str, tmp_path: Path
) -> None:
    count = len(_recording()[1])

    def in_ms(lines: list[str]) -> None:
        first = len(lines) - count
        lines[:first] = [line.replace(f"\t{count}\t", f"\t{count - 30}\t") for line in lines[:first]]
        for row, line in enumerate(lines[first:]):
            cells = line.split(separator)
            cells[column] = f"{row / RATE:.3f}"
            lines[first + row] = separator.join(cells)
        del lines[first + 100 : first + 130]

    capture = read_capture(_written(tmp_path / f"swing{suffix}", in_ms))
    assert capture.rate == pytest.approx(RATE)
    assert len(capture.points) == count
    assert np.flatnonzero(np.isnan(capture.points[:, 0, 0])).tolist() == list(range(100, 130))


def test_read_capture_trc_header_of_several_tabs_is_read(tmp_path: Path) -> None:
    def tabs(lines: list[str]) -> None:
        lines[2] = "  " + "\t\t ".join(lines[2].split("\t"))

    path = _written(tmp_path / "swing.trc", tabs)
    assert (read_capture(path).rate, read_capture(path).unit) == (RATE, "m")


@pytest.mark.parametrize("suffix", [".c3d", ".trc"])
@pytest.mark.parametrize("part", [0.3, 0.97])
def test_read_capture_truncated_file_refused(suffix: str, part: float, tmp_path: Path) -> None:
    path = _written(tmp_path / f"swing{suffix}")
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    assert str(path) in _refusal(path).location


@pytest.mark.parametrize(
    "content", [b"", b"\x02\x50" + bytes(2000), bytes(range(256)) * 20], ids=["empty", "zeros", "noise"]
)
@pytest.mark.parametrize("suffix", [".c3d", ".trc", ".csv", ".bvh"])
def test_read_capture_foreign_content_refused(suffix: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / f"other{suffix}"
    path.write_bytes(content)
    assert str(path) in _refusal(path).location


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_read_capture_csv_encodings_are_read(encoding: str, tmp_path: Path) -> None:
    path = _csv(tmp_path)
    path.write_text(path.read_text(), encoding=encoding)
    assert read_capture(path).rate == RATE


def test_read_capture_trc_path_in_windows_encoding_is_read(tmp_path: Path) -> None:
    path = _written(tmp_path / "swing.trc")
    path.write_bytes(path.read_bytes().replace(b"swing.trc", b"C:\\J\xf6rg\\swing.trc"))
    assert read_capture(path).rate == RATE


BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  End Site
  {
    OFFSET 0 1 0
  }
}
MOTION
Frames: 40
Frame Time: 0.008333
"""


def test_read_capture_bvh_with_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = tmp_path / "swing.bvh"
    path.write_text(BVH + 40 * "1 2 3 0 0 0\n", encoding="utf-8-sig")
    assert read_capture(path).points[0].tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize(
    ("old", "new", "location", "found"),
    [
        ("Zposition", "Wposition", "line 5", "CHANNELS 6 Xposition Yposition Wposition"),
        ("0.008333", "0", "line 13", "frame time 0"),
        ("0.008333", "", "line 13", "frame time nan"),
        ("Frames: 40", "Frames: 41", "line 12", "40 frames"),
    ],
)
def test_read_capture_damaged_bvh_reports_line(
    old: str, new: str, location: str, found: str, tmp_path: Path
) -> None:
    path = tmp_path / "swing.bvh"
    path.write_text(BVH.replace(old, new) + 40 * "1 2 3 0 0 0\n")
    refusal = _refusal(path)
    assert location in refusal.location
    assert found in refusal.found


def test_import_wrong_unit_suggests_fitting_unit(tmp_path: Path) -> None:
    golfer = Synthetic(unit="mm")
    path = write(tmp_path / "swing.trc", *golfer.recording(), RATE, "m")
    with pytest.raises(BenchError) as refused:
        imported(path)
    assert "they would fit mm" in refused.value.action


def test_read_capture_gears_file_suggests_c3d_export(tmp_path: Path) -> None:
    assert "export C3D from GEARS" in _refusal(tmp_path / "swing.gears").action


def test_import_role_without_marker_lists_markers(tmp_path: Path) -> None:
    path = _csv(tmp_path)
    with pytest.raises(BenchError) as refused:
        imported(path, map_text=MAP.replace("left_wrist", "#"))
    assert "no marker for left_wrist" in refused.value.found
    assert "LWRI1" in refused.value.found


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('elbow = ["LSHO1"]', "no such role"),
        ('grip = ["GRIPS"]', "no such marker"),
        ("grip = 3", "3"),
        ("grip = [", "invalid TOML"),
    ],
)
def test_import_damaged_map_refused(text: str, found: str, tmp_path: Path) -> None:
    with pytest.raises(BenchError) as refused:
        imported(_csv(tmp_path), map_text=text)
    assert found in refused.value.found


def test_import_swapped_lead_and_trail_refused(tmp_path: Path) -> None:
    swapped = MAP.replace("left_", "trail_").replace("right_", "lead_")
    with pytest.raises(BenchError, match="sides swapped"):
        imported(_csv(tmp_path), map_text=swapped)


@pytest.mark.parametrize(
    ("options", "location"),
    [
        (ImportOptions(lead="right"), "swing.csv"),
        (ImportOptions(up="-z"), "--up"),
        (ImportOptions(impact=9.0), "--events impact"),
        (ImportOptions(top=1.30), "--events top"),
        (ImportOptions(top=float("nan")), "--events top"),
        (ImportOptions(top=float("inf")), "--events top"),
    ],
    ids=["lead", "up", "impact", "top", "top nan", "top inf"],
)
def test_import_contradicting_option_refused(options: ImportOptions, location: str, tmp_path: Path) -> None:
    with pytest.raises(BenchError) as refused:
        imported(_csv(tmp_path), options=options)
    assert location in refused.value.location


def test_read_capture_c3d_without_package_names_extra(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    path = tmp_path / "swing.c3d"
    path.write_bytes(b"\x02\x50")
    assert "golfbench[mocap]" in _refusal(path).action
