"""Golfers: the wrist is free, speed and tempo are theirs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.config import load_configuration
from bench.design.designer import SwingDemand, top_pose
from bench.design.golfer_tracking import RUN_UP, demand_like, gave_way
from bench.swing.golfers import (
    GOLFERS,
    Golfer,
    free_wrist,
    human_downswing,
)
from bench.swing.profile import Profile
from sim.kane import inverse_dynamics
from sim.plant import PlantParameters

FOLLOWED = ("tour-male", "tour-female", "average-male", "average-female", "senior")


@pytest.mark.parametrize("name", FOLLOWED)
def test_a_scaled_golfer_has_the_head_speed_of_his_or_her_kind(plant: PlantParameters, name: str) -> None:
    human = human_downswing(plant, GOLFERS[name])
    assert human.reaches
    assert human.head_speed == pytest.approx(GOLFERS[name].head_speed, rel=1e-3)
    assert human.head[-1] == pytest.approx([plant.site.ball_x, plant.site.ball_y], abs=0.25)


def test_a_golfer_whose_wrist_meets_its_stop_first_is_as_fast_as_can_be(plant: PlantParameters) -> None:
    human = human_downswing(plant, replace(GOLFERS["tour-male"], head_speed=70.0))
    assert human.reaches
    assert 50.0 < human.head_speed < 70.0


@pytest.mark.parametrize("golfer", GOLFERS.values(), ids=GOLFERS)
def test_a_golfers_demand_stays_in_the_robots_ranges(plant: PlantParameters, golfer: Golfer) -> None:
    human = human_downswing(plant, golfer)
    demand = demand_like(plant, golfer, human, SwingDemand())
    assert demand.head_speed == golfer.head_speed
    assert demand.backswing_time == golfer.backswing
    top = top_pose(plant, demand)
    assert demand.follow is not None
    counted = np.asarray(np.isfinite(demand.follow).all(axis=1))
    assert np.all(demand.follow[counted] >= top - 1e-9)
    assert np.all(demand.follow[counted, 2] <= plant.wrist.upper)
    # Where the robot can go, the human's own motion is asked for.
    lasting = float(human.time[-1])
    time = np.linspace(0.0, lasting, len(human.angle))
    begin = lasting - demand.downswing_time[1] if not counted.all() else 0.0
    at = np.linspace(begin, lasting, len(demand.follow))
    wrist = np.interp(at, time, human.angle[:, 2])
    inside = counted & (wrist > top[2]) & (wrist < plant.wrist.upper)
    assert demand.follow[inside, 2] == pytest.approx(wrist[inside], abs=1e-3)
    assert inside.any()
    assert demand_like(plant, golfer, human, SwingDemand(), 30.0).head_speed == 30.0


@pytest.mark.parametrize("golfer", GOLFERS.values(), ids=GOLFERS)
def test_a_robot_with_room_behind_the_golfers_top_begins_there_in_a_run_up(golfer: Golfer) -> None:
    plant = load_configuration(Path("golfers")).plant
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


def test_a_golfers_arms_are_not_those_of_the_robot_beside(plant: PlantParameters) -> None:
    longer = replace(plant, robot=replace(plant.robot, l56=0.24, stroke=0.33))
    own, beside = (human_downswing(p, GOLFERS["senior"]) for p in (plant, longer))
    # The rod's mass has moved, and the free wrist feels it: a little.
    assert beside.angle[:9] == pytest.approx(own.angle[:9], abs=1e-3)


def test_what_gave_way_is_told_with_both_figures(slow_swing: Profile) -> None:
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


def test_hunts_functions_are_taken_as_given(plant: PlantParameters) -> None:
    human = human_downswing(plant, GOLFERS["two-handicap"])
    assert human.amplitude == 1.0
    assert np.diff(human.angle[:, 0]) == pytest.approx(11.8028 * 2.5e-4)


def test_the_wrist_is_free(plant: PlantParameters) -> None:
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


def test_a_wrist_at_its_stop_stays(plant: PlantParameters) -> None:
    angle, speed = np.full((50, 3), 5.2), np.zeros((50, 3))
    angle[:, 0], angle[:, 1] = -1.0, 3.9
    speed[0, 2] = -5.0
    free_wrist(plant.robot.record, angle, speed, np.zeros(50), 5.2, 6.3, 1e-4)
    assert angle[:, 2].min() == 5.2
