"""The swings of the bag on their sites: delivered as demanded, and safe if the bench falls silent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.config import load_configuration
from bench.control.moves.braking import lifted_angle
from bench.design.stop_verification import TRIALS, SwingCheck
from bench.simulation.simulated_bench import simulate_swing
from sim.kinematics import forward_kinematics
from tests.bench.design.bag_demands import DEMANDS, mounted
from tests.compiled_only import needs_speed
from tests.sampling import release_except

AROUND_THE_BALL = range(-80, 121, 20)
"""Ticks from the ball at which the bench falls silent."""

each_swing = pytest.mark.parametrize("name", release_except({"iron7-78mph", "wedge56-55yd"}, DEMANDS))


@each_swing
@needs_speed
def test_bag_swing_delivers_as_demanded(name: str) -> None:
    demand, delivery = DEMANDS[name], simulate_swing(mounted(name)).delivery
    assert delivery is not None
    assert delivery.speed == pytest.approx(demand.speed, rel=0.002)
    assert np.degrees(delivery.attack_angle) == pytest.approx(demand.attack, abs=0.1)
    assert abs(delivery.in_plane_error) < 0.5e-3


@each_swing
@needs_speed
def test_bag_swing_silent_bench_ends_safely(name: str) -> None:
    bench = mounted(name)
    profile, unwatched = bench.profile, bench.envelope.with_model_check("off")
    check = SwingCheck(bench.plant, profile, bench.control, unwatched, bench.estimator)
    silent = [trial for trial in TRIALS if trial.name.startswith("bench silent")]
    contact = round(profile.impact_time / profile.period)
    instants = [contact + ticks for ticks in AROUND_THE_BALL]
    outcomes = check.outcomes(tuple(silent), ticks=instants)
    assert len(outcomes) == 2 * len(instants)
    assert [(outcome.time, outcome.unsafe) for outcome in outcomes if outcome.unsafe] == []


def test_lifted_angle_straight_club_clears_turf() -> None:
    bag = load_configuration(Path("bag"))
    for name in ("wood3", "iron7", "wedge56"):
        plant = bag.plant_with(club=name)
        pose = forward_kinematics(plant.robot, [0.0, lifted_angle(plant), 2 * np.pi])
        reach = float(np.hypot(pose[0], pose[1]))
        assert -reach - plant.site.sole_depth - plant.site.ground == pytest.approx(0.005, abs=1e-9)
