"""Nelson's rules by patterns made by hand, and how often chance alone signals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.campaign.plan.shot_sequence import Arm, PlannedShot, Role
from bench.campaign.statistics.control_chart import NELSON, control_charts, nelson_signals
from bench.records.shot.shot import Shot, ShotStatus
from tests.bench.campaign.plans import row_of, shipped_plan

PLAN = shipped_plan("symmetry")

QUIET = [0.3, -0.4, 1.2, -1.3, 0.2, 0.6, -0.2, -1.1]
PATTERNS = {
    1: [3.1],
    2: [0.2, 0.5, 0.3, 1.2, 0.4, 0.1, 0.6, 0.2, 0.5],
    3: [-1.4, -0.8, -0.3, 0.2, 0.9, 1.5],
    4: [-1.0, *[0.1, -0.2] * 6, 0.1],
    5: [2.1, 0.1, 2.2],
    6: [1.1, 1.2, -0.5, 1.3, 1.1],
    7: [0.2, -0.3, -0.5, 0.4, 0.6, -0.1, -0.4, 0.3, 0.5, -0.6, -0.2, 0.7, 0.1, -0.8, -0.3],
    8: [1.1, -1.2, -1.5, 1.4, 1.2, -1.1, 1.6],
}


@pytest.mark.parametrize("rule", NELSON)
def test_nelson_signals_pattern_signals_rule_at_last_value(rule: int) -> None:
    pattern = [*QUIET, *PATTERNS[rule]]
    for sign in (1, -1):
        found = nelson_signals(sign * np.array(pattern))
        assert found[rule] == [len(pattern) - 1]
        shorter = nelson_signals(sign * np.array([*QUIET, *PATTERNS[rule][:-1]]))
        assert rule not in shorter


def test_nelson_signals_random_values_match_stated_run_length() -> None:
    random, lengths = np.random.default_rng(1), []
    for _ in range(1500):
        found = nelson_signals(random.normal(size=1200))
        lengths.append(min((places[0] for places in found.values()), default=1199) + 1)
    assert np.mean(lengths) == pytest.approx(74, abs=6)
    single = nelson_signals(random.normal(size=200_000))[1]
    assert 200_000 / len(single) == pytest.approx(370, rel=0.15)


def _control(number: int, carry: float) -> Shot:
    trial = PlannedShot(Role.CONTROL, 1, number, 1, Arm("default", "driver", "tour"))
    return row_of(trial, number, carry_m=carry, ball_speed_mps=62.0 + 0.1 * (number % 3))


def test_control_charts_limits_come_from_moving_range() -> None:
    values = np.random.default_rng(5).normal(183.0, 1.5, 400)
    shots = [_control(n, float(value)) for n, value in enumerate(values, 1)]
    shots[10] = replace(shots[10], status=ShotStatus.EXCLUDED, reason="lost", carry_m=300.0)
    shots[20] = replace(shots[20], carry_m=200.0)
    carry, speed = control_charts(PLAN, shots)
    assert (carry.column, speed.column) == ("carry_m", "ball_speed_mps")
    assert carry.sd == pytest.approx(1.5, rel=0.12)
    assert 11 not in carry.shots
    assert 21 in carry.signals[1]
    drifted = [replace(shot, carry_m=(shot.carry_m or 0) + 0.02 * shot.shot) for shot in shots]
    chart = control_charts(PLAN, drifted)[0]
    assert chart.sd == pytest.approx(carry.sd, rel=0.02)
    assert {1, 2} <= chart.signals.keys()


def test_control_charts_few_values_give_no_chart() -> None:
    assert control_charts(PLAN, [_control(n, 183.0) for n in range(1, 8)]) == control_charts(PLAN, []) == ()
    same = control_charts(PLAN, [replace(_control(n, 183.0), ball_speed_mps=62.0) for n in range(1, 30)])
    assert [chart.signals for chart in same] == [{}, {}]
