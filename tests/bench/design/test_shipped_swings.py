"""The shipped swings on their sites: delivered as demanded, and safe if the bench falls silent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.base.lifecycle import Cause
from bench.config import load_configuration
from bench.control.moves.braking import lifted_angle
from bench.design.optimal_control import SwingDemand
from bench.design.static_checks import profile_faults
from bench.design.stop_verification import TRIALS, SwingCheck
from bench.simulation.simulated_bench import PoweredBench, simulate_swing
from bench.swing.golfers import GOLFERS
from bench.swing.library import find_profile, profile_names
from bench.swing.profile import load_profile
from sim.kinematics import forward_kinematics
from tests.bench.design.shipped_demands import DEMANDS, mounted
from tests.compiled_only import needs_speed
from tests.sampling import release_except

BAG = [name for name, demand in DEMANDS.items() if demand.configuration == "bag"]
SAMPLE = {"default", "driver-130mph", "tour-male-full", "iron7-78mph", "wedge56-55yd"}
AROUND_THE_BALL = range(-80, 121, 20)
"""Ticks from the ball at which the bench falls silent."""


def test_demands_cover_every_shipped_profile() -> None:
    assert sorted(DEMANDS) == profile_names()


@needs_speed
@pytest.mark.slow
@pytest.mark.parametrize("name", release_except(SAMPLE, DEMANDS))
def test_shipped_swing_delivers_as_demanded(name: str) -> None:
    bench, demand = mounted(name), DEMANDS[name]
    delivery, told, limits = simulate_swing(bench).delivery, bench.profile.delivery, bench.profile.limits
    assert delivery is not None
    assert delivery.speed == pytest.approx(demand.speed, rel=0.002)
    assert np.degrees(delivery.attack_angle) == pytest.approx(demand.attack, abs=0.1)
    assert delivery.in_plane_error == pytest.approx(demand.strike, abs=0.5e-3)
    # What the file tells is what the simulated bench did when it was made: both are one rehearsal.
    assert told["head_speed_mps"] == pytest.approx(delivery.speed, abs=0.05)
    assert told["in_plane_error_mm"] == pytest.approx(1e3 * delivery.in_plane_error, abs=0.5)
    assert max(limits["stop_share_missed"], limits["stop_share_silent"]) <= 1.0
    assert limits["greatest_opening"] == 0.85


@pytest.mark.parametrize("name", release_except(SAMPLE, DEMANDS))
def test_shipped_swing_missed_ball_keeps_stop_energy(name: str) -> None:
    bench = mounted(name)
    powered = PoweredBench(bench)
    assert powered.arm()
    missed = powered.swing(None)
    assert missed.cause == Cause.NONE
    assert np.all(missed.loads.stop_energy <= [[a.stop.energy] for a in bench.plant.actuators])


@pytest.mark.parametrize("name", DEMANDS)
def test_shipped_swing_has_no_faults_and_keeps_wrist_off_end_stop_at_ball(name: str) -> None:
    """At the stop, which of two swings met it before the ball was a matter of tenths of a millisecond."""
    bench = mounted(name)
    assert profile_faults(bench.profile, bench.plant, bench.envelope) == []
    period = bench.profile.period
    at, part = divmod(bench.profile.impact_time / period, 1.0)
    earlier, before = bench.profile.angle[int(at) - 1 : int(at) + 1, 2]
    turning = (before - earlier) / period
    wrist = before + part * period * turning
    assert (bench.plant.wrist.upper - wrist) / turning > 0.8 * SwingDemand().before_stop


def test_shipped_profile_text_reports_missing_speed() -> None:
    profile, golfer = load_profile(find_profile("tour-male")), GOLFERS["tour-male"]
    reached = profile.delivery["head_speed_mps"]
    told = f"demanded {golfer.head_speed:.1f} m/s, reached {reached:.1f} m/s, short by"
    assert f"{told} {golfer.head_speed - reached:.1f} m/s" in profile.text


@needs_speed
@pytest.mark.parametrize("name", release_except({"iron7-78mph", "wedge56-55yd"}, BAG))
def test_bag_swing_silent_bench_ends_safely(name: str) -> None:
    bench = mounted(name)
    check = SwingCheck(replace(bench, envelope=bench.envelope.with_model_check("off")))
    silent = [trial for trial in TRIALS if trial.name.startswith("bench silent")]
    contact = round(bench.profile.impact_time / bench.profile.period)
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
