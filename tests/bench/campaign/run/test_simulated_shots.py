"""A simulated shot depends on plan and number only; each fault is reported with its kind."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import degrees
from pathlib import Path

import numpy as np
import pytest

from bench.campaign.plan.gate import Centre
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.plan.shot_sequence import Step, all_trials
from bench.campaign.run._simulated_shots import SimulatedShots, hear
from bench.campaign.run.plan_requirements import require_swings
from bench.campaign.run.shot_source import MonitorResult, Taken
from bench.config import Configuration
from bench.records.shot.shot import ShotStatus
from bench.records.shot.shot_matcher import UNREPORTED
from bench.records.telemetry.cycle_record import CYCLE
from bench.simulation.swing_operator import never
from drivers.base import Launch
from drivers.launch_monitor.record import MatchWindow
from sim.simulated_monitor import MonitorParameters
from tests.bench.campaign.as_designed import AsDesigned


@pytest.fixture(scope="module")
def plan(configuration: Configuration) -> CampaignPlan:
    plan = load_plan(Path("clubs"), configuration)
    faulty = replace(
        plan.simulation, missing_launch=(2,), missed_ball=(3,), feeder_jam=(4,), guard_opened=(5,)
    )
    return replace(plan, simulation=faulty)


@pytest.fixture(scope="module")
def profiles(plan: CampaignPlan, configuration: Configuration) -> AsDesigned:
    return AsDesigned(require_swings(plan, configuration))


@pytest.fixture(scope="module")
def source(plan: CampaignPlan, configuration: Configuration, profiles: AsDesigned) -> SimulatedShots:
    return SimulatedShots(plan, configuration, profiles, never)


def _take(source: SimulatedShots, plan: CampaignPlan, number: int, sample: int = 1) -> Taken:
    return source.take(Step(all_trials(plan)[number], 1, Centre()), number, sample)


@pytest.mark.slow
def test_simulated_shots_are_independent_of_previous_shots(
    source: SimulatedShots, plan: CampaignPlan, configuration: Configuration, profiles: AsDesigned
) -> None:
    for number in (1, 3, 7):
        _take(source, plan, number)
    again = _take(source, plan, 6)
    fresh = _take(SimulatedShots(plan, configuration, profiles, never), plan, 6)
    assert again.shot == fresh.shot
    assert again.cycles is not None
    assert fresh.cycles is not None
    for name in CYCLE.names or ():
        np.testing.assert_array_equal(again.cycles[name], fresh.cycles[name], err_msg=name)


@pytest.mark.slow
def test_simulated_shots_foreseen_equal_those_taken_alone(
    source: SimulatedShots, plan: CampaignPlan, configuration: Configuration, profiles: AsDesigned
) -> None:
    trials = all_trials(plan)
    club = trials[8].arm.club
    coming = [number for number in range(8, 20) if trials[number].arm.club == club]
    with SimulatedShots(plan, configuration, profiles, never) as ahead:
        _take(ahead, plan, coming[0])  # arms
        for number, after in pairwise(coming[1:6]):
            ahead.foresee(number, iter([(trials[number], 1), (trials[after], 2)]))  # the second is not taken
            assert ahead._ahead
            found, expected = _take(ahead, plan, number), _take(source, plan, number)
            assert found.shot == expected.shot
            assert found.cycles is not None
            assert expected.cycles is not None
            assert found.cycles.tobytes() == expected.cycles.tobytes()


def test_simulated_shots_differ_by_number_and_ball(source: SimulatedShots, plan: CampaignPlan) -> None:
    speeds = {_take(source, plan, number, sample).shot.ball_speed_mps for number, sample in ((8, 1), (8, 2))}
    assert len(speeds) == 2
    assert _take(source, plan, 9).shot.club_speed_mps != _take(source, plan, 10).shot.club_speed_mps


def test_simulated_shots_planned_faults_set_status_and_reason(
    source: SimulatedShots, plan: CampaignPlan
) -> None:
    unseen, missed, jam = (_take(source, plan, number) for number in (2, 3, 4))
    assert (unseen.shot.status, unseen.shot.reason) == (ShotStatus.EXCLUDED, "the launch monitor saw no ball")
    assert unseen.shot.club_speed_mps is not None
    assert unseen.shot.ball_speed_mps is None
    assert unseen.struck
    assert (missed.shot.status, missed.shot.reason) == (ShotStatus.FAILED, "no ball on the tee")
    assert missed.cycles is not None
    assert not missed.struck
    assert (jam.shot.status, jam.cycles, jam.struck) == (ShotStatus.FAILED, None, False)
    assert ("guard", "guard opened; a simulated bench resets and arms itself") in _take(
        source, plan, 5
    ).events


def test_simulated_shots_monitor_faults_exclude_shot(
    plan: CampaignPlan, configuration: Configuration, profiles: AsDesigned
) -> None:
    clear = replace(plan, simulation=replace(plan.simulation, missing_launch=()))
    source = SimulatedShots(clear, configuration, profiles, never)
    source._monitor = replace(source._monitor, misread=1.0)
    misread = _take(source, plan, 6)
    assert misread.shot.status is ShotStatus.EXCLUDED
    assert misread.shot.reason
    assert misread.shot.ball_speed_mps is not None  # kept, and not counted
    assert (misread.shot.carry_m, misread.shot.launch_source) == (None, "simulated")
    source._monitor = replace(source._monitor, misread=0.0, double=1.0, speed_noise=0.001)
    assert "2 different launches" in _take(source, plan, 7).shot.reason
    source._monitor = replace(source._monitor, double=0.0)
    clean = _take(source, plan, 7).shot
    assert (clean.status, clean.reason) == (ShotStatus.VALID, "")
    assert (clean.carry_m or 0.0) > 100.0


def test_simulated_shots_club_loft_changes_dynamic_loft(source: SimulatedShots, plan: CampaignPlan) -> None:
    taken = [_take(source, plan, number) for number in (6, 7, 8, 9, 10, 11)]
    lofts = {one.shot.club: one.shot.dynamic_loft_deg or 0.0 for one in taken}
    assert lofts["driver"] - lofts["driver-9"] == pytest.approx(1.5, abs=0.2)
    assert lofts["driver-12"] - lofts["driver"] == pytest.approx(1.5, abs=0.2)


LAUNCH = Launch(62.0, 0.2, 0.01, 300.0, 0.02)
QUIET = MonitorParameters(speed_noise=0.0, angle_noise=0.0, spin_noise=0.0, axis_noise=0.0)


def heard(parameters: MonitorParameters, number: int = 1) -> MonitorResult:
    return hear(LAUNCH, number, 43.0, parameters, MatchWindow())


def test_hear_without_faults_returns_ball_launch() -> None:
    launch, reason = heard(QUIET)
    assert reason == ""
    assert launch is not None
    assert launch.launch == pytest.approx(LAUNCH, rel=1e-4, abs=1e-4)
    assert launch.source == "launch monitor"


def test_hear_monitor_faults_return_reason() -> None:
    assert heard(replace(QUIET, dropped=(3,)), 3) == (None, UNREPORTED)
    assert heard(replace(QUIET, dropped=(3,)), 4).reason == ""
    assert heard(replace(QUIET, missing=1.0)) == (None, UNREPORTED)
    assert "2 different launches" in heard(replace(QUIET, double=1.0, speed_noise=0.001)).reason
    assert heard(replace(QUIET, repeated=1.0)).reason == ""  # sent again, not measured again
    assert heard(replace(QUIET, ghost=1.0)).reason == ""  # half a minute later: nobody's
    no_spin = heard(replace(QUIET, no_spin=1.0))
    assert "no spin" in no_spin.reason
    assert no_spin.launch is not None
    assert no_spin.launch.speed == pytest.approx(62.0, rel=1e-4)
    misread = [heard(replace(QUIET, misread=1.0), number) for number in range(1, 20)]
    assert all(each.reason and each.launch is not None for each in misread)
    assert degrees(min(each.launch.launch_angle or 0.0 for each in misread if each.launch)) == 0.0


def test_hear_seed_repeats_faults_at_configured_share() -> None:
    parameters = replace(QUIET, missing=0.2, seed=7)
    missing = [heard(parameters, number).launch is None for number in range(1, 301)]
    assert missing == [heard(parameters, number).launch is None for number in range(1, 301)]
    assert 30 < sum(missing) < 90
