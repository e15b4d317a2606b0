"""Golfers: the measured motion at their speed; Hunt's functions with a free wrist."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.config import load_configuration
from bench.design.designer import top_pose
from bench.design.golfer_tracking import RUN_UP, SLOWER, TEMPO, demand_like, gave_way
from bench.design.optimal_control import SwingDemand
from bench.swing.golfers import DOWNSWING_DURATION, GOLFERS, Golfer, free_wrist, human_downswing
from bench.swing.profile import Profile
from sim.kane import inverse_dynamics
from sim.kinematics import right_arm_length
from sim.plant import PlantParameters

FROM_REST = [golfer for golfer in GOLFERS.values() if not golfer.as_hunt]


@pytest.mark.parametrize("golfer", FROM_REST, ids=lambda golfer: golfer.name)
def test_human_downswing_time_scales_with_head_speed(plant: PlantParameters, golfer: Golfer) -> None:
    human, senior = human_downswing(plant, golfer), human_downswing(plant, GOLFERS["senior"])
    assert human.head_speed == golfer.head_speed
    reached = np.hypot(*(np.diff(human.head[-2:], axis=0)[0] / np.diff(human.time[-2:])))
    assert reached == pytest.approx(golfer.head_speed, rel=1e-9)
    assert human.head[-1] == pytest.approx([plant.site.ball_x, plant.site.ball_y], abs=0.05)
    assert human.angle == pytest.approx(senior.angle)
    assert human.time == pytest.approx(senior.time * senior.head_speed / golfer.head_speed)
    begin = np.abs(np.gradient(human.angle, human.time, axis=0))[1]
    assert np.all(begin < 0.5), "rad/s at the top"


@pytest.mark.parametrize("golfer", FROM_REST, ids=lambda golfer: golfer.name)
def test_human_downswing_lies_within_measured_ranges(plant: PlantParameters, golfer: Golfer) -> None:
    """Two persons: tops of the shoulder, ranges of the arm, wrist cocked until 100 ms before the ball."""
    human = human_downswing(plant, golfer)
    degrees = np.degrees(human.angle)
    assert -107.0 <= degrees[0, 0] <= -89.0
    assert 30.0 <= np.ptp(degrees[:, 1]) <= 48.0
    cocked = degrees[human.time <= human.time[-1] - 0.1, 2]
    assert cocked.min() >= 232.0
    assert cocked[human.time[: len(cocked)] <= 0.6 * human.time[-1]].max() <= 246.0


def test_human_downswing_unreachable_ball_is_refused(plant: PlantParameters) -> None:
    far = replace(plant, site=replace(plant.site, ball_x=2.5))
    with pytest.raises(BenchError, match=r"golfer senior: .*x = 2.5 m"):
        human_downswing(far, GOLFERS["senior"])


@pytest.mark.parametrize("golfer", GOLFERS.values(), ids=GOLFERS)
def test_demand_like_stays_within_robot_ranges(plant: PlantParameters, golfer: Golfer) -> None:
    human = human_downswing(plant, golfer)
    demand = demand_like(plant, golfer, human, SwingDemand())
    assert demand.head_speed == golfer.head_speed
    assert demand.backswing_time == golfer.backswing
    top = top_pose(plant, demand)
    assert demand.follow is not None
    counted = np.asarray(np.isfinite(demand.follow).all(axis=1))
    assert np.all(demand.follow[counted] >= top - 1e-9)
    assert np.all(demand.follow[counted, 2] <= plant.wrist.upper)
    # Where the robot can go, the human's own motion is demanded.
    lasting = float(human.time[-1])
    time = np.linspace(0.0, lasting, len(human.angle))
    begin = lasting - demand.downswing_time[1] if not counted.all() else 0.0
    at = np.linspace(begin, lasting, len(demand.follow))
    wrist = np.interp(at, time, human.angle[:, 2])
    inside = counted & (wrist > top[2]) & (wrist < plant.wrist.upper)
    assert demand.follow[inside, 2] == pytest.approx(wrist[inside], abs=1e-3)
    assert inside.any()
    slower = demand_like(plant, golfer, human, SwingDemand(), 30.0)
    assert slower.head_speed == 30.0
    if not golfer.as_hunt:
        longer = lasting * golfer.head_speed / 30.0
        assert slower.downswing_time == pytest.approx((longer - TEMPO, SLOWER * longer))


def test_demand_like_room_behind_top_adds_run_up() -> None:
    plant, golfer = load_configuration(Path("golfers")).plant, GOLFERS["two-handicap"]
    human = human_downswing(plant, golfer)
    demand = demand_like(plant, golfer, human, SwingDemand())
    assert demand.downswing_time == (float(human.time[-1]) + RUN_UP,) * 2
    turning = (human.angle[1, 0] - human.angle[0, 0]) / (human.time[1] - human.time[0])
    assert demand.top_shoulder == pytest.approx(human.angle[0, 0] - turning * RUN_UP / 2)
    assert top_pose(plant, demand)[0] >= plant.shoulder.lower + 0.1
    assert demand.follow is not None
    # What comes before the golfer's top does not count.
    left_out = np.asarray(np.isnan(demand.follow).all(axis=1))
    share = RUN_UP / demand.downswing_time[0]
    assert left_out.mean() == pytest.approx(share, abs=1.5 / len(demand.follow))
    assert not left_out[-1]
    assert human.angle[0, 2] >= plant.wrist.lower


def test_human_downswing_other_right_arm_keeps_angles(plant: PlantParameters) -> None:
    longer = replace(plant, robot=replace(plant.robot, l56=0.24, stroke=0.33))
    own, beside = (human_downswing(p, GOLFERS["two-handicap"]) for p in (plant, longer))
    # The rod's mass has moved, and the free wrist feels it: a little.
    assert beside.angle[:9] == pytest.approx(own.angle[:9], abs=1e-3)


def test_gave_way_lists_demanded_and_reached_figures(slow_swing: Profile) -> None:
    # The slow swing takes 0.5 s from the top to the ball.
    delivery = {"head_speed_mps": 48.6, "attack_angle_deg": 2.0}
    swing = replace(slow_swing, delivery=delivery)
    met = SwingDemand(head_speed=48.6, attack=np.radians(2.0).item(), downswing_time=(0.4, 0.5))
    assert gave_way(met, swing) == []
    assert gave_way(replace(met, head_speed=None), swing) == []
    more = SwingDemand(head_speed=51.4, attack=0.0, downswing_time=(0.2, 0.25))
    assert gave_way(more, swing) == [
        "a downswing of 0.500 s, 0.250 s at most demanded",
        "attack +2.0 deg, +0.0 deg demanded",
        "demanded 51.4 m/s, reached 48.6 m/s, short by 2.8 m/s",
    ]


def test_human_downswing_of_hunt_keeps_shoulder_speed(plant: PlantParameters) -> None:
    human = human_downswing(plant, GOLFERS["two-handicap"])
    assert np.diff(human.angle[:, 0]) == pytest.approx(11.8028 * 2.5e-4)
    assert human.angle[0, 0] == pytest.approx(0.45 - 1.810354)


def test_human_downswing_of_hunt_lengthens_arm_in_cubic_step(plant: PlantParameters) -> None:
    human = human_downswing(plant, GOLFERS["two-handicap"])
    length = right_arm_length(plant.robot, human.angle[:, 1])
    grown = np.interp([0.0, DOWNSWING_DURATION / 4], human.time, length) - 0.34 - 0.2125
    assert grown == pytest.approx([-0.2035, -0.2035 * (1 - 0.25**2 * 2.5)], abs=1e-5)
    assert np.diff(length).max() < 0.5e-3  # without a jump


def test_free_wrist_effort_is_zero(plant: PlantParameters) -> None:
    step, n = 1e-5, 4000
    angle, speed = np.zeros((n, 3)), np.zeros((n, 3))
    angle[:, 0], angle[:, 1] = -1.0 + 8.0 * step * np.arange(n), 3.9
    speed[:, 0] = 8.0
    angle[0, 2] = 5.2
    free_wrist(plant.robot.record, angle, speed, np.zeros(n), 4.0, 7.0, step)
    rate = np.gradient(speed, step, axis=0)
    effort = inverse_dynamics(plant.robot, angle[5:-5], speed[5:-5], rate[5:-5])
    assert np.abs(effort[:, 2]).max() < 0.05
    assert np.ptp(angle[:, 2]) > 0.01


def test_free_wrist_at_end_stop_stays(plant: PlantParameters) -> None:
    angle, speed = np.full((50, 3), 5.2), np.zeros((50, 3))
    angle[:, 0], angle[:, 1] = -1.0, 3.9
    speed[0, 2] = -5.0
    free_wrist(plant.robot.record, angle, speed, np.zeros(50), 5.2, 6.3, 1e-4)
    assert angle[:, 2].min() == 5.2
