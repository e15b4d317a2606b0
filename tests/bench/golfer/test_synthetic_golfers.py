"""Synthetic golfers, whose angles are known, are recovered from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.golfer.golfer_file import ImportOptions, MeasuredSwing, summary
from bench.golfer.measuring import measure
from bench.golfer.recording import read_capture
from bench.golfer.roles import find_roles
from tests.bench.golfer.synthetic import BALL, MAP, Array, Synthetic, angles, write


def imported(path: Path, *, map_text: str = MAP, options: ImportOptions | None = None) -> MeasuredSwing:
    """Return the swing in `path` by the map of the synthetic golfers."""
    map_path = path.with_name("map.toml")
    map_path.write_text(map_text)
    capture = read_capture(path)
    return measure(capture, find_roles(capture, map_path), options or ImportOptions())


def recorded(golfer: Synthetic, path: Path, gaps: dict[str, tuple[int, int]] | None = None) -> Path:
    """Write the camera recording of `golfer`; `gaps` are the missing frames by role."""
    names, points = golfer.recording()
    for name, (first, end) in (gaps or {}).items():
        points[first:end, [k for k, marker in enumerate(names) if marker.startswith(name)]] = np.nan
    return write(path, names, points, golfer.rate, golfer.unit)


def errors(swing: MeasuredSwing) -> Array:
    """Return the errors of the angles (n, 3) over the downswing in degrees."""
    away = np.degrees(swing.angle - angles(BALL + swing.time))[swing.downswing]
    wrapped: Array = (away + 180.0) % 360.0 - 180.0
    return wrapped


def true_top(golfer: Synthetic) -> float:
    """Return the instant of the slowest lead wrist before the ball (s)."""
    time = np.arange(0.8, 1.2, 1e-3)
    speed = np.linalg.norm(np.gradient(golfer.joints(time)["LWRI"], axis=0), axis=1)
    return float(time[np.argmin(speed)])


CASES = {
    "C3D in m": (Synthetic(), ".c3d"),
    "C3D in mm, left-handed, Y up": (Synthetic(unit="mm", left_handed=True, up="y"), ".c3d"),
    "TRC in mm": (Synthetic(unit="mm"), ".trc"),
    "TRC in cm, Y up, noise": (Synthetic(unit="cm", up="y", noise=0.001), ".trc"),
    "CSV in m": (Synthetic(), ".csv"),
    "CSV in mm, left-handed": (Synthetic(unit="mm", left_handed=True), ".csv"),
    "turned, steep": (Synthetic(turned=2.4, plane=float(np.radians(61.0))), ".csv"),
    "100 Hz": (Synthetic(rate=100), ".csv"),
    "120 Hz": (Synthetic(rate=120), ".csv"),
    "200 Hz, noise of 1 mm": (Synthetic(rate=200, noise=0.001), ".csv"),
    "240 Hz, noise of 1 mm": (Synthetic(noise=0.001, seed=5), ".csv"),
    "360 Hz, noise of 1 mm": (Synthetic(rate=360, noise=0.001), ".csv"),
    "500 Hz, noise of 1 mm": (Synthetic(rate=500, noise=0.001), ".csv"),
    "240 Hz, noise of 3 mm": (Synthetic(noise=0.003), ".csv"),
    "360 Hz, noise of 3 mm": (Synthetic(rate=360, noise=0.003), ".csv"),
    "500 Hz, noise of 3 mm": (Synthetic(rate=500, noise=0.003), ".csv"),
    "ball of foam": (Synthetic(loss=0.0), ".csv"),
    "ball of foam, noise of 3 mm": (Synthetic(rate=500, noise=0.003, loss=0.0), ".csv"),
}


@pytest.mark.parametrize(("golfer", "suffix"), CASES.values(), ids=CASES)
def test_measure_synthetic_golfer_matches_known_angles(
    golfer: Synthetic, suffix: str, tmp_path: Path
) -> None:
    swing = imported(recorded(golfer, tmp_path / f"swing{suffix}"))
    away = errors(swing)
    assert np.sqrt(np.mean(away**2, axis=0)).max() < 0.5
    assert np.abs(away[0]).max() < 0.5
    if golfer.rate >= 120 and golfer.noise < 0.002 and golfer.loss:
        assert np.abs(away[-1]).max() < 0.5
    assert abs(swing.impact_time - BALL) < 0.001
    assert abs(swing.impact_time + swing.time[swing.top_row] - true_top(golfer)) < 0.012
    assert np.degrees(swing.plane) == pytest.approx(np.degrees(golfer.plane), abs=0.5)
    assert swing.orientation.lead == ("right" if golfer.left_handed else "left")
    velocity = np.diff(golfer.joints(np.array([BALL - 1e-5, BALL]))["HEAD"], axis=0) / 1e-5
    assert swing.speed["head"][-1] == pytest.approx(
        np.linalg.norm(velocity), rel=0.015 if golfer.rate > 100 else 0.05
    )


@pytest.mark.parametrize("role", ["HEAD", "LWRI", "GRIP", "LSHO"])
def test_measure_short_downswing_gap_keeps_impact_and_angles(role: str, tmp_path: Path) -> None:
    golfer = Synthetic()
    whole = imported(recorded(golfer, tmp_path / "whole.csv"))
    swing = imported(recorded(golfer, tmp_path / "gaps.csv", {role: (290, 295)}))
    assert sum(swing.gaps.values()) == 5
    assert abs(swing.impact_time - whole.impact_time) < 0.001
    assert np.abs(swing.angle[[swing.top_row, -1]] - whole.angle[[whole.top_row, -1]]).max() < np.radians(0.1)
    assert np.abs(errors(swing)).max() < 0.5


@pytest.mark.parametrize(
    "other",
    [Synthetic(left_handed=True), Synthetic(turned=-2.0), Synthetic(unit="mm"), Synthetic(up="y")],
    ids=str,
)
def test_measure_other_recording_of_same_swing_gives_same_angles(other: Synthetic, tmp_path: Path) -> None:
    swing = imported(recorded(Synthetic(), tmp_path / "one.csv"))
    same = imported(recorded(other, tmp_path / "other.csv"))
    assert swing.impact_time == pytest.approx(same.impact_time, abs=1e-4)
    assert np.abs(swing.angle - same.angle).max() < np.radians(0.02)
    assert swing.separation == pytest.approx(same.separation, abs=1e-3)


def test_measure_mirrored_points_reports_left_handed_axes_and_keeps_angles(
    tmp_path: Path,
) -> None:
    golfer = Synthetic()
    names, points = golfer.recording()
    swing = imported(write(tmp_path / "one.csv", names, points, golfer.rate))
    mirrored = imported(write(tmp_path / "other.csv", names, points * [-1.0, 1.0, 1.0], golfer.rate))
    assert mirrored.orientation.lead == "left"
    assert "axes are left-handed" in mirrored.orientation.lead_clue
    assert np.abs(swing.angle - mirrored.angle).max() < np.radians(0.02)


def test_measure_without_club_markers_gives_shoulders_and_arm_only(tmp_path: Path) -> None:
    body = "\n".join(line for line in MAP.splitlines() if not line.startswith(("grip", "head")))
    swing = imported(recorded(Synthetic(), tmp_path / "body.csv"), map_text=body)
    assert np.isnan(swing.angle[:, 2]).all()
    assert "head" not in swing.speed
    assert any("no club" in text for text in swing.not_measured)
    assert swing.impact_clue == "hands at their position at address"


def test_find_roles_lead_trail_map_gives_same_angles(tmp_path: Path) -> None:
    path = recorded(Synthetic(), tmp_path / "swing.csv")
    by_side = imported(path)
    by_lead = imported(path, map_text=MAP.replace("left_", "lead_").replace("right_", "trail_"))
    assert by_lead.orientation.lead == "left"
    assert np.array_equal(by_side.angle, by_lead.angle)


def test_import_options_top_and_impact_override_detection(tmp_path: Path) -> None:
    path = recorded(Synthetic(), tmp_path / "swing.csv")
    swing = imported(path, options=ImportOptions(top=1.06, impact=1.31))
    assert swing.impact_time == pytest.approx(1.31)
    assert swing.time[swing.top_row] == pytest.approx(-0.25, abs=1e-3)
    assert swing.impact_clue == swing.top_clue == "--events"


def test_measure_reports_off_plane_lead_shoulder_and_hub_travel(tmp_path: Path) -> None:
    found = summary(imported(recorded(Synthetic(), tmp_path / "swing.csv")))
    assert 240 < found["off_plane_rms_mm"]["lead_shoulder"] < 300
    assert found["off_plane_rms_mm"]["head"] < 5
    assert found["hub_travel_mm"][0] > 20
