"""Rules judge at their own set-up only, by section, in their own units, with the uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, date, datetime
from math import pi, radians
from typing import Any

import numpy as np
import pytest

from bench.campaign.plan.conformity_rules import control_ball_speed, rule_names, rule_on, rule_sets
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import Arm, PlannedShot, Role
from bench.campaign.report._conformity import Decision, RuleFinding, decide_by_limit, judge_rules
from bench.campaign.report.findings import findings, findings_record
from bench.campaign.report.report_format import UnitSystem
from bench.records.shot.shot import Shot
from drivers.base import Launch
from sim.ball import Air, Ball
from sim.flight import fly
from tests.bench.campaign.plans import row_of, shipped_plan, with_values

YARD = 0.9144
WHEN = datetime(2026, 11, 22, 10, 0, tzinfo=UTC)
ODS = (78.679, 10.0, 2520.0)
"""Ball speed m/s, launch angle deg, spin rpm of the set-up in force."""
ROBOT = (63.0, 13.0, 2700.0)
TEST_AIR = Air(297.04, 101_592.0, 0.5)
"""75 deg F, 30.00 inches of mercury."""


@pytest.fixture
def distance() -> CampaignPlan:
    return shipped_plan("distance")


def _shots(
    set_up: tuple[float, float, float],
    totals: Sequence[float],
    *,
    ball: str = "candidate",
    section: int = 1,
    source: str = "measured",
    balls: int = 12,
    when: datetime = WHEN,
) -> list[Shot]:
    """Return shots of `ball` with `totals` (yd, as total and as carry) and as many of the control ball."""
    columns: dict[str, Any] = dict(
        zip(("ball_speed_mps", "launch_angle_deg", "spin_rpm"), set_up, strict=True)
    )
    columns |= {"carry_source": source, "carry_measured_error_m": 0.5, "time_utc": when}
    found = []
    for n, total in enumerate(totals):
        for role, name in ((Role.CONTROL, "tour"), (Role.TEST, ball)):
            trial = PlannedShot(role, section, n + 1, 1, Arm("default", "driver", name))
            row = row_of(trial, 100 * section + 2 * n + (role is Role.TEST), 1 + n % balls, **columns)
            found.append(replace(row, carry_m=total * YARD, total_m=total * YARD))
    return found


def _scatter(mean: float, count: int = 12) -> list[float]:
    return list(mean + np.linspace(-2.0, 2.0, count))


def _only(found: Sequence[RuleFinding]) -> RuleFinding:
    (one,) = found
    return one


def _with_rules(plan: CampaignPlan, *names: str) -> CampaignPlan:
    return with_values(plan, rules={"apply": names})


def test_judge_rules_long_ball_is_judged_only_at_rule_set_up(
    distance: CampaignPlan,
) -> None:
    # 363 and 378 yd at the set-ups of 2004 and 2030, 280 yd at the robot's 63 m/s: it was "inside" twice.
    long = Ball("candidate", drag_factor=0.8)
    totals = []
    for speed, angle, spin in (ODS, (81.808, 11.0, 2200.0), ROBOT):
        launch = Launch(speed, radians(angle), 0.0, spin * pi / 30, 0.0)
        totals.append(fly(launch, TEST_AIR, long).total / YARD)
    assert totals[:2] == pytest.approx([363, 378], abs=1.0)
    assert totals[2] < 300
    found = judge_rules(distance, _shots(ROBOT, _scatter(totals[2])))
    assert [one.rule for one in found] == ["ods-2004", "ods-2030"]
    assert {one.decision for one in found} == {Decision.NOT_JUDGED}
    assert "ball speed 63.0 m/s, rule 78.7 ± 0.5 m/s" in found[0].words_in(UnitSystem.US)
    assert "launch angle 13.0 °, rule 10.0 ± 0.5 °" in found[0].words_in(UnitSystem.US)
    at_set_up = _only(judge_rules(_with_rules(distance, "ods"), _shots(ODS, _scatter(totals[0]))))
    assert at_set_up.decision is Decision.FAILS
    assert "362.3 ±" in at_set_up.words_in(UnitSystem.US)
    assert "at most 320.0 yd (331.3 ± " in at_set_up.words_in(UnitSystem.SI)
    assert ", at most 292.6 m) – " in at_set_up.words_in(UnitSystem.SI)


@pytest.mark.parametrize(
    ("mean", "decision"),
    [(309.0, Decision.CONFORMS), (318.0, Decision.INCONCLUSIVE), (331.0, Decision.FAILS)],
)
def test_judge_rules_decision_includes_uncertainty(
    distance: CampaignPlan, mean: float, decision: Decision
) -> None:
    found = _only(judge_rules(_with_rules(distance, "ods"), _shots(ODS, _scatter(mean))))
    assert found.decision is decision
    assert found.unit == "yd"
    assert found.at_most == pytest.approx(320.0)
    # stated 2.5 m, coefficients 0.5 m, scatter of 12 balls 1.26/sqrt(12) yd; coverage near 2
    assert found.uncertainty == pytest.approx(2 * np.hypot(2.5495 / YARD, 1.316 / 12**0.5), rel=0.02)
    assert found.coverage == pytest.approx(2.0, abs=0.02)


def test_decide_by_limit_applies_guard_band() -> None:
    assert decide_by_limit(317.0, 3.0, 320.0) is Decision.CONFORMS
    assert decide_by_limit(317.1, 3.0, 320.0) is Decision.INCONCLUSIVE
    assert decide_by_limit(323.0, 3.0, 320.0) is Decision.INCONCLUSIVE
    assert decide_by_limit(323.1, 3.0, 320.0) is Decision.FAILS


@pytest.mark.release
def test_judge_rules_ball_at_limit_conforms_once_in_44(distance: CampaignPlan) -> None:
    random, passed, count = np.random.default_rng(20261122), 0, 3000
    plan = with_values(distance, rules={"apply": ("ods",), "uncertainty": {"total_m": 0.0}})
    shots = [replace(s, carry_measured_error_m=None) for s in _shots(ODS, [320.0] * 12, source="simulated")]
    for _ in range(count):
        noise = iter(random.normal(0.0, 2.0, len(shots)))
        drawn = [replace(s, total_m=(s.total_m or 0.0) + next(noise)) for s in shots]
        passed += _only(judge_rules(plan, drawn)).decision is Decision.CONFORMS
    assert passed / count == pytest.approx(0.0228, abs=0.008)


def test_judge_rules_judges_each_section_separately() -> None:
    rules = {"apply": ("symmetry", "ods"), "uncertainty": {"total_m": 1.0}}
    plan = shipped_plan("ten-balls", design={"balls": ("a",), "blocks": 12}, rules=rules)
    shots = [
        *_shots(ODS, _scatter(165.8), ball="a", section=1),
        *_shots(ROBOT, _scatter(209.7), ball="a", section=2),
    ]
    found = [one for one in judge_rules(plan, shots) if one.rule == "ods-2004"]
    assert [one.section for one in found] == [1, 2]
    assert [one.decision for one in found] == [Decision.CONFORMS, Decision.NOT_JUDGED]
    assert [one.value for one in found] == pytest.approx([165.8, 209.7])
    assert "section 1 (" in found[0].words_in(UnitSystem.US)


def test_judge_rules_date_selects_rule_set(distance: CampaignPlan) -> None:
    assert {"ods", "ods-2004", "ods-2030", "symmetry"} <= set(rule_names())
    for day, name in ((date(2026, 11, 22), "ods-2004"), (date(2030, 1, 1), "ods-2030")):
        rule = rule_on("ods", day)
        assert rule is not None
        assert rule.name == name
    assert rule_on("ods", date(1990, 1, 1)) is None
    later = judge_rules(distance, _shots(ODS, _scatter(300.0), when=datetime(2031, 5, 1, tzinfo=UTC)))
    assert [one.rule for one in later] == ["ods-2030"], "the family's set of that day, once"
    shots = _shots((81.8, 11.0, 2200.0), _scatter(300.0))
    early = _only(judge_rules(_with_rules(distance, "ods-2030"), shots))
    assert early.decision is Decision.CONFORMS
    assert "Not in force on 2026-11-22: 2030-01-01" in early.words_in(UnitSystem.US)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"carry_source": "reference"}, "total_m from reference, not of the ball that was hit"),
        ({"carry_source": "model"}, "total_m from model"),
        ({"total_m": None}, "0 valid shots with total_m"),
        ({"role": "test", "ball": "candidate"}, "no control ball"),
        ({"spin_rpm": None}, "spin of the control ball not measured"),
    ],
)
def test_judge_rules_not_judged_reports_reason(
    distance: CampaignPlan, change: dict[str, object], reason: str
) -> None:
    shots = [replace(shot, **change) for shot in _shots(ODS, _scatter(300.0))]  # type: ignore[arg-type]
    found = _only(judge_rules(_with_rules(distance, "ods"), shots))
    assert found.decision is Decision.NOT_JUDGED
    assert reason in found.words_in(UnitSystem.US)


def test_judge_rules_unstated_uncertainty_is_reported(distance: CampaignPlan) -> None:
    plan = with_values(distance, rules={"apply": ("ods",), "uncertainty": {}})
    found = _only(judge_rules(plan, _shots(ODS, _scatter(300.0))))
    assert "the uncertainty of total_m is not stated" in found.words_in(UnitSystem.US)


def test_judge_rules_unfinished_section_is_not_judged(distance: CampaignPlan) -> None:
    plan = _with_rules(distance, "ods")
    half = _only(judge_rules(plan, _shots(ODS, _scatter(300.0, 6))))
    assert half.decision is Decision.NOT_JUDGED
    assert "the section is not finished, 50 % of its shots are done" in half.words_in(UnitSystem.US)


def test_judge_rules_initial_velocity_is_not_judged(distance: CampaignPlan) -> None:
    found = _only(judge_rules(_with_rules(distance, "initial-velocity"), _shots(ODS, _scatter(300.0))))
    assert (found.decision, found.unit) == (Decision.NOT_JUDGED, "ft/s")
    assert "43.83 m/s" in found.words_in(UnitSystem.US)


def test_judge_rules_control_ball_figures_set_ball_speed(distance: CampaignPlan) -> None:
    own = {"control_restitution": 0.82, "control_contact_time": 430e-6}
    plan = with_values(_with_rules(distance, "ods"), set_up=own)
    assert control_ball_speed(0.82, 430e-6) == pytest.approx(80.17, abs=0.01)
    slow = _only(judge_rules(plan, _shots(ODS, _scatter(300.0))))
    assert "ball speed 78.7 m/s, rule 80.2 ± 0.5 m/s" in slow.words_in(UnitSystem.US)
    right = _only(judge_rules(plan, _shots((80.2, 10.0, 2520.0), _scatter(300.0))))
    assert right.decision is Decision.CONFORMS


def test_judge_rules_single_ball_is_reported(distance: CampaignPlan) -> None:
    found = _only(judge_rules(_with_rules(distance, "ods"), _shots(ODS, _scatter(300.0), balls=1)))
    assert "One ball of candidate was hit" in found.words_in(UnitSystem.US)


def test_judge_rules_repeated_hits_widen_uncertainty(distance: CampaignPlan) -> None:
    plan = _with_rules(distance, "ods")
    totals = [305.0, 299.0, 301.0, 295.0] * 6  # four balls, six equal hits each
    few = _only(judge_rules(plan, _shots(ODS, totals, balls=4)))
    many = _only(judge_rules(plan, _shots(ODS, totals, balls=24)))
    assert few.uncertainty is not None
    assert many.uncertainty is not None
    assert few.uncertainty > 1.2 * many.uncertainty


def test_judge_rules_symmetry_compares_within_section() -> None:
    plan = shipped_plan("symmetry")
    pole = _shots(ODS, _scatter(260.0), ball="pole", source="monitor")
    for gap, decision in ((1.0, Decision.CONFORMS), (9.0, Decision.FAILS)):
        seam = _shots(ODS, _scatter(260.0 - gap), ball="seam", source="monitor")
        found = _only(judge_rules(plan, [*pole, *seam]))
        assert (found.level, found.decision) == ("pole against seam", decision)
        assert found.value == pytest.approx(gap)
    slow = _only(judge_rules(plan, _shots(ROBOT, _scatter(200.0), ball="pole", source="monitor")))
    assert slow.decision is Decision.NOT_JUDGED


def test_findings_record_holds_rule_decisions(distance: CampaignPlan) -> None:
    rules = findings_record(findings(distance, _shots(ROBOT, _scatter(250.0))))["rules"]
    assert [rule["rule"] for rule in rules] == ["ods-2004", "ods-2030"]
    assert {rule["decision"] for rule in rules} == {"not judged"}
    assert rules[0]["value"] == pytest.approx(250.0)


def test_flight_model_matches_overall_distance_standard() -> None:
    # The limit of 317 yd was set in 2004 to what the longest balls did then, and a notice of 2023 expects
    # 13 to 15 yd from the set-up of 2030 to that of 2004. Nothing in the model was fitted to either.
    total = {}
    for name, rule in rule_sets().items():
        if rule.family == "ods" and rule.set_up is not None:
            s = rule.set_up
            launch = Launch(s.ball_speed, radians(s.launch_angle_deg), 0.0, s.spin_rpm * pi / 30, 0.0)
            total[name] = fly(launch, TEST_AIR).total / YARD
    assert total["ods-2004"] == pytest.approx(317.0, abs=9.0)
    assert 12.0 < total["ods-2030"] - total["ods-2004"] < 16.0
