from __future__ import annotations

from dataclasses import replace
from math import degrees

import pytest

from bench.campaign.simulated_shots import MonitorResult, hear
from bench.shot.shot_matcher import NOT_TOLD
from drivers.base import Launch
from drivers.launch_monitor.matching import MatchWindow
from sim.launch_monitor import MonitorParameters

LAUNCH = Launch(62.0, 0.2, 0.01, 300.0, 0.02)
QUIET = MonitorParameters(speed_noise=0.0, angle_noise=0.0, spin_noise=0.0, axis_noise=0.0)


def heard(parameters: MonitorParameters, number: int = 1) -> MonitorResult:
    return hear(LAUNCH, number, 43.0, parameters, MatchWindow())


def test_without_faults_the_figures_are_the_balls_as_the_protocol_rounds_them() -> None:
    launch, reason = heard(QUIET)
    assert reason == ""
    assert launch is not None
    assert launch.launch == pytest.approx(LAUNCH, rel=1e-4, abs=1e-4)
    assert launch.source == "launch monitor"


def test_what_goes_wrong_has_its_reason() -> None:
    assert heard(replace(QUIET, dropped=(3,)), 3) == (None, NOT_TOLD)
    assert heard(replace(QUIET, dropped=(3,)), 4).reason == ""
    assert heard(replace(QUIET, missing=1.0)) == (None, NOT_TOLD)
    assert "2 different launches" in heard(replace(QUIET, double=1.0)).reason
    assert heard(replace(QUIET, repeated=1.0)).reason == ""  # sent again, not measured again
    assert heard(replace(QUIET, ghost=1.0)).reason == ""  # half a minute later: nobody's
    no_spin = heard(replace(QUIET, no_spin=1.0))
    assert "no spin" in no_spin.reason
    assert no_spin.launch is not None
    assert no_spin.launch.speed == pytest.approx(62.0, rel=1e-4)
    misread = [heard(replace(QUIET, misread=1.0), number) for number in range(1, 20)]
    assert all(each.reason and each.launch is not None for each in misread)
    assert degrees(min(each.launch.launch_angle or 0.0 for each in misread if each.launch)) == 0.0


def test_a_seed_gives_the_same_faults_in_about_their_share() -> None:
    parameters = replace(QUIET, missing=0.2, seed=7)
    missing = [heard(parameters, number).launch is None for number in range(1, 301)]
    assert missing == [heard(parameters, number).launch is None for number in range(1, 301)]
    assert 30 < sum(missing) < 90
