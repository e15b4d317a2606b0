"""Uncertainty budgets: the GUM's arithmetic, missing contributions, and coverage of the truth by U."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf, radians
from typing import Any

import numpy as np
import pytest
from scipy import stats

from bench.campaign.plan.plan import CampaignPlan, StatedCalibration, stated_uncertainties
from bench.campaign.plan.shot_sequence import Arm, PlannedShot, Role
from bench.campaign.report._budget import UncertaintyBudget, flight_slopes, uncertainty_budgets
from bench.records.shot.shot import Shot
from drivers.base import Launch
from sim.ball import Air
from sim.flight import fly
from tests.bench.campaign.plans import row_of, shipped_plan, with_values

BENCH: dict[str, Any] = {
    "bench": {
        "in_force": [
            {
                "kind": kind,
                "subject": club,
                "version": 3,
                "date": "2026-01-01T",
                "method": "jig",
                "values": values,
            }
            for kind, club, values in (
                ("club", "driver", {"length_uncertainty": 5e-4}),
                ("encoders", "", {"uncertainty": 1e-3}),
            )
        ],
        "club_speed": [{"swing": "default", "club": "driver", "length": 21.0, "zeros": -2.0}],
    }
}
MONITOR = StatedCalibration(
    "launch monitor",
    "no. 7",
    "certificate 1",
    "2026-01-01",
    "",
    {"ball_speed_mps": 0.1, "launch_angle": 0.2, "spin_rpm": 30.0, "carry_m": 0.7},
    40.0,
)


def _plan(*calibrations: StatedCalibration) -> CampaignPlan:
    return replace(shipped_plan("symmetry"), calibrations={str(n): one for n, one in enumerate(calibrations)})


def _shots(carry_source: str = "monitor", seed: int = 1, off: float = 0.0) -> list[Shot]:
    random = np.random.default_rng(seed)
    trials = [
        PlannedShot(Role.TEST, 1, n // 2 + 1, 1, Arm("default", "driver", ("pole", "seam")[n % 2]))
        for n in range(24)
    ]
    return [
        row_of(
            trial,
            n,
            sample=trial.block,
            club_speed_mps=42.6 + 0.02 * random.normal(),
            ball_speed_mps=62.0 + 0.1 * random.normal() + off,
            launch_angle_deg=12.0 + 0.2 * random.normal(),
            spin_rpm=2500 + 40 * random.normal(),
            carry_m=180 + random.normal(),
            delivery_source="encoders+model",
            carry_source=carry_source,
        )
        for n, trial in enumerate(trials, 1)
    ]


def _of(budgets: tuple[UncertaintyBudget, ...], column: str) -> UncertaintyBudget:
    return next(one for one in budgets if one.column == column and one.level == "pole")


def test_uncertainty_budgets_combine_squares_with_effective_dof() -> None:
    shots = _shots()
    found = _of(uncertainty_budgets(_plan(MONITOR), shots, BENCH, simulated=False), "ball_speed_mps")
    values = np.array([shot.ball_speed_mps for shot in shots if shot.ball == "pole"], dtype=float)
    a = values.std(ddof=1) / np.sqrt(12)
    assert found.mean == pytest.approx(values.mean())
    assert found.type_a == pytest.approx(a)
    assert found.type_b == 0.1
    assert found.combined == pytest.approx(hypot(a, 0.1))
    assert found.dof == pytest.approx(found.combined**4 / (a**4 / 11 + 0.1**4 / 40))
    assert found.coverage == pytest.approx(stats.t.ppf(0.97724986805182, found.dof))
    assert found.expanded == pytest.approx(found.coverage * found.combined)
    assert [line.kind for line in found.lines] == ["A", "B"]
    assert found.lines[1].source == "launch monitor, no. 7, certificate 1, 2026-01-01"


def test_uncertainty_budgets_club_speed_includes_bench_calibrations() -> None:
    found = _of(uncertainty_budgets(_plan(), _shots(), BENCH, simulated=False), "club_speed_mps")
    length, zeros = found.lines[1:]
    assert (length.name, zeros.name) == ("length of the club", "zeros of the encoders")
    assert length.contribution == pytest.approx(21.0 * 5e-4)
    assert zeros.contribution == pytest.approx(2e-3)
    assert found.expanded is not None
    bare = _of(uncertainty_budgets(_plan(), _shots(), {}, simulated=False), "club_speed_mps")
    assert bare.expanded is None
    assert bare.missing == "length of the club not calibrated, zeros of the encoders not calibrated"


def test_uncertainty_budgets_carry_uses_monitor_or_launch_and_air() -> None:
    plan = _plan(MONITOR, StatedCalibration("station", uncertainty={"air_temperature_k": 0.3}))
    monitor = _of(uncertainty_budgets(plan, _shots(), BENCH, simulated=False), "carry_m")
    assert monitor.type_b == 0.7
    flown = _of(uncertainty_budgets(plan, _shots("reference"), BENCH, simulated=False), "carry_m")
    assert flown.missing == "no calibration states air_pressure_pa"
    assert flown.expanded is None
    inputs = {line.input: line for line in flown.lines if line.kind == "B"}
    assert set(inputs) == {"ball_speed_mps", "launch_angle", "spin_rpm", "air_temperature_k"}
    assert inputs["ball_speed_mps"].contribution == pytest.approx(0.1 * inputs["ball_speed_mps"].sensitivity)
    measured = [replace(s, carry_source="measured", carry_measured_error_m=1.5) for s in _shots()]
    coefficients = _of(uncertainty_budgets(plan, measured, BENCH, simulated=False), "carry_m").lines[-1]
    assert (coefficients.name, coefficients.contribution) == ("aerodynamics of the ball", 1.5)


def test_flight_slopes_match_flight_model() -> None:
    slopes = flight_slopes(_shots())
    at = [Launch(62.0 + one, radians(12.0), 0.0, 261.8, 0.0) for one in (0.5, -0.5)]
    assert slopes["ball_speed_mps"] == pytest.approx(fly(at[0]).carry - fly(at[1]).carry, rel=0.03)
    launch, hot, cold = Launch(62.0, radians(12.0), 0.0, 261.8, 0.0), Air(299.15), Air(297.15)
    by_air = (fly(launch, hot).carry - fly(launch, cold).carry) / 2
    assert slopes["air_temperature_k"] == pytest.approx(by_air, abs=0.02)
    assert flight_slopes([replace(shot, spin_rpm=None) for shot in _shots()]) == {}


def test_uncertainty_budgets_only_hardware_names_missing_calibration() -> None:
    bare = _of(uncertainty_budgets(_plan(), _shots(), BENCH, simulated=False), "launch_angle_deg")
    assert (bare.expanded, bare.missing) == (None, "no calibration states launch_angle")
    simulated = _of(uncertainty_budgets(_plan(), _shots(), {}, simulated=True), "launch_angle_deg")
    assert simulated.expanded is not None
    assert simulated.type_b == 0


def test_stated_uncertainty_uses_rule_or_calibrations() -> None:
    plan = _plan(MONITOR)
    assert hypot(*(one.uncertainty for one in stated_uncertainties(plan, "carry_m"))) == pytest.approx(0.7)
    assert stated_uncertainties(plan, "total_m") == []
    stated = with_values(plan, rules={"uncertainty": {"carry_m": 2.5}})
    assert [one.uncertainty for one in stated_uncertainties(stated, "carry_m")] == [2.5]
    two = _plan(MONITOR, replace(MONITOR, uncertainty={"carry_m": 2.4}))
    assert hypot(*(one.uncertainty for one in stated_uncertainties(two, "carry_m"))) == pytest.approx(2.5)


def test_uncertainty_budgets_expanded_uncertainty_covers_truth() -> None:
    plan, random, covered, tries = _plan(replace(MONITOR, dof=0.0)), np.random.default_rng(9), 0, 400
    for seed in range(tries):
        shots = [s for s in _shots(seed=seed, off=0.1 * random.normal()) if s.ball == "pole"]
        values = np.array([shot.ball_speed_mps for shot in shots], dtype=float)
        found = uncertainty_budgets(plan, shots, BENCH, simulated=False)
        speed = next(one for one in found if one.column == "ball_speed_mps")
        assert speed.expanded is not None
        assert speed.dof < inf
        covered += abs(values.mean() - 62.0) <= speed.expanded
    assert covered / tries == pytest.approx(0.9545, abs=0.025)
