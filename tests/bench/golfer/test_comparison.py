"""Deviations are those of their definition."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from bench.base.errors import BenchError
from bench.config import load_configuration
from bench.golfer.comparison import SwingMotion, beyond_ranges, compare_motions, golfer_motion, robot_motion
from bench.golfer.golfer_file import ImportOptions, load_golfer, save_golfer
from bench.golfer.measuring import measure
from bench.golfer.recording import read_capture
from bench.golfer.roles import find_roles
from bench.swing.golfers import GOLFERS
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.plant import PlantParameters
from tests.bench.golfer.synthetic import BALL, MAP, Synthetic, angles, write


@pytest.fixture
def motion(plant: PlantParameters, slow_swing: Profile) -> SwingMotion:
    """A robot's swing in which each joint moves."""
    found = robot_motion(plant, slow_swing)
    return replace(found, angle=found.angle + 0.5 * found.time[:, None])


def _as_golfer(motion: SwingMotion) -> SwingMotion:
    return replace(motion, source="measured")


def test_compare_motions_same_swing_has_zero_error(motion: SwingMotion) -> None:
    found = compare_motions(_as_golfer(motion), motion)
    assert found.error == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-9)
    assert motion.time[-1] >= 0.0
    assert motion.head[-1] == pytest.approx([0.0, 0.0], abs=0.05)


def test_compare_motions_constant_shift_divides_by_range(motion: SwingMotion) -> None:
    shifted = replace(motion, angle=motion.angle + [0.1, 0.0, 2 * np.pi], head=motion.head + [0.03, 0.04])
    found = compare_motions(_as_golfer(motion), shifted)
    rows = motion.time >= -motion.downswing - 1e-9
    down = motion.angle[rows]
    assert found.error == pytest.approx((0.1, 0.0, 0.0, 0.05))
    assert found.share[0] == pytest.approx(0.1 / np.ptp(down[:, 0]))
    assert found.share[3] == pytest.approx(0.05 / pdist(motion.head[rows]).max(), rel=0.01)


def test_compare_motions_missing_instants_do_not_count(motion: SwingMotion) -> None:
    late = motion.time >= -motion.downswing / 2
    begins_late = replace(motion, time=motion.time[late], angle=motion.angle[late], head=motion.head[late])
    found = compare_motions(_as_golfer(motion), begins_late)
    assert found.time[0] >= begins_late.time[0]
    assert found.error == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-9)


def test_compare_motions_time_shift_raises_error(motion: SwingMotion) -> None:
    late = replace(motion, time=motion.time - 0.010)
    assert compare_motions(_as_golfer(motion), late).error[0] > 0.005


def test_compare_motions_robot_as_reference_raises(motion: SwingMotion) -> None:
    with pytest.raises(BenchError, match="Put the golfer first"):
        compare_motions(motion, motion)


@pytest.mark.parametrize("noise", [0.0, 0.001])
def test_compare_motions_two_captures_of_same_swing_agree(noise: float, tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(MAP)
    plant, motions = load_configuration(None).plant, []
    for golfer in (Synthetic(), Synthetic(rate=360, noise=noise, up="y")):
        path = write(tmp_path / f"at{golfer.rate:g}.csv", *golfer.recording(), golfer.rate)
        capture = read_capture(path)
        roles = find_roles(capture, tmp_path / "map.toml")
        swing = measure(capture, roles, ImportOptions())
        saved = save_golfer(tmp_path, path.stem, swing, capture, roles)
        motions.append(golfer_motion(plant, load_golfer(saved)))
    found = compare_motions(*motions)
    assert max(found.share) < 0.01
    true = np.ptp(angles(BALL + np.arange(-motions[0].downswing, 0.0, 1e-3)), axis=0)
    down = motions[0].angle[motions[0].time >= -motions[0].downswing]
    assert np.ptp(down, axis=0) == pytest.approx(true, abs=0.02)


def test_compare_motions_unmeasured_joint_gives_nan(plant: PlantParameters, motion: SwingMotion) -> None:
    body = _as_golfer(replace(motion, angle=motion.angle * [1.0, 1.0, np.nan], head=motion.head * np.nan))
    found = compare_motions(body, motion)
    assert found.share[:2] == pytest.approx((0.0, 0.0), abs=1e-9)
    assert np.isnan(found.share[2:]).all()
    assert np.isnan(beyond_ranges(plant, body.angle)[2])


def test_beyond_ranges_returns_excess(plant: PlantParameters) -> None:
    middle = [(plant.shoulder.lower + plant.shoulder.upper) / 2, 4.2, plant.wrist.upper - 0.1]
    within = np.array([middle, middle])
    further = within + [[0.0, 0.0, 0.0], [0.0, 0.0, 0.3]]
    assert beyond_ranges(plant, within) == (0.0, 0.0, 0.0)
    assert beyond_ranges(plant, further) == pytest.approx((0.0, 0.0, 0.2))


@pytest.mark.parametrize("golfer", GOLFERS)
def test_golfers_variant_delivers_documented_speed_and_deviation(golfer: str) -> None:
    plant, profile = load_configuration(Path("golfers")).plant, load_profile(find_profile(f"{golfer}-full"))
    away = compare_motions(golfer_motion(plant, GOLFERS[golfer]), robot_motion(plant, profile)).share
    assert profile.delivery["head_speed_mps"] == pytest.approx(GOLFERS[golfer].head_speed, abs=0.05)
    assert max(away) <= (0.12 if golfer == "two-handicap" else 0.07)


@pytest.mark.parametrize("golfer", ["tour-female", "average-male", "average-female", "senior"])
def test_shipped_robot_follows_golfer_shoulder_and_arm(plant: PlantParameters, golfer: str) -> None:
    away = compare_motions(
        golfer_motion(plant, GOLFERS[golfer]), robot_motion(plant, load_profile(find_profile(golfer)))
    )
    assert max(away.share[:2]) <= 0.05
