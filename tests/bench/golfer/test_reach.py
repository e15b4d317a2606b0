"""Angles at which a robot holds its club as a golfer does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.base.errors import BenchError
from bench.golfer.comparison import beyond_ranges, with_club_held
from bench.golfer.golfer_file import GolferSwing
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.kinematics import forward_kinematics
from sim.plant import PlantParameters

PLANT = PlantParameters()
TOP = 200


def swing() -> NDArray[np.float64]:
    """Return angles (n, 3) of the default swing, from before its top to the ball (rad)."""
    profile = load_profile(find_profile("default"))
    return profile.angle[profile.begins[3] - TOP : profile.begins[5]]


@pytest.fixture
def golfer() -> GolferSwing:
    """A golfer whose club moves as the robot's does in its default swing, and whose body does not."""
    return with_the_club_of(swing())


def with_the_club_of(angle: NDArray[np.float64]) -> GolferSwing:
    """Return a golfer whose club moves as a robot's at `angle` (n, 3; rad), and whose body does not."""
    pose = forward_kinematics(PLANT.robot, angle)
    time = np.arange(1.0 - len(angle), 0.5) / 1e3
    body = angle + [0.3, -0.2, -0.1]
    path = Path("ann.golfer.toml")
    return GolferSwing("Ann", time, body, _head(pose - pose[-1]), 43.0, TOP, 0.9, path, "5e1f")


def _head(path: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the positions of a golfer of whom only the head's path (n, 2 or more) matters."""
    return {"head": np.column_stack([path[:, :2], np.zeros(len(path))])}


@pytest.fixture
def plant() -> PlantParameters:
    """The robot whose ball is where that swing ends."""
    x, y = forward_kinematics(PLANT.robot, swing()[-1])[:2].tolist()
    return replace(PLANT, site=replace(PLANT.site, ball_x=x, ball_y=y))


def test_with_club_held_robot_club_returns_robot_angles(golfer: GolferSwing, plant: PlantParameters) -> None:
    held = with_club_held(plant, golfer)
    assert (held.name, held.follow) == ("Ann", "club")
    assert np.isnan(held.angle[:TOP]).all()
    assert held.angle[TOP:] == pytest.approx(swing()[TOP:], abs=1e-9)


def test_with_club_held_shoulder_beyond_half_turn_stays_continuous(plant: PlantParameters) -> None:
    far = swing()
    far[:, 0] = far[-1, 0] + 2.5 * (far[:, 0] - far[-1, 0])
    assert far[TOP, 0] < -np.pi < far[-1, 0]
    held = with_club_held(plant, with_the_club_of(far))
    assert held.angle[TOP:] == pytest.approx(far[TOP:], abs=1e-9)
    assert beyond_ranges(plant, held.angle[TOP:])[0] == pytest.approx(
        plant.shoulder.lower - far[TOP:, 0].min()
    )


def test_with_club_held_club_slightly_out_of_reach_holds_nearest(
    golfer: GolferSwing, plant: PlantParameters
) -> None:
    robot, row, head = plant.robot, TOP + 20, golfer.head.copy()
    wrist = forward_kinematics(replace(robot, club=replace(robot.club, length_to_face=0.0)), swing()[row])[:2]
    reached, away = np.linalg.norm(wrist), 0.01
    head[row] += wrist / reached * (robot.l12 + robot.l23 + away - reached)
    held = with_club_held(plant, replace(golfer, position=_head(head))).angle[row]
    missed = forward_kinematics(robot, held)[:2] - head[row] - (plant.site.ball_x, plant.site.ball_y)
    assert np.linalg.norm(missed) == pytest.approx(away, abs=0.002)


def test_with_club_held_club_out_of_reach_reports_instant(
    golfer: GolferSwing, plant: PlantParameters
) -> None:
    head = golfer.head.copy()
    head[TOP + 30] += (1.5, 0.0)
    with pytest.raises(BenchError, match=r"ms before the ball(?s:.)*where the arm reaches"):
        with_club_held(plant, replace(golfer, position=_head(head)))


def test_with_club_held_without_club_raises(golfer: GolferSwing, plant: PlantParameters) -> None:
    with pytest.raises(BenchError, match="grip and head"):
        with_club_held(plant, replace(golfer, position={}))
