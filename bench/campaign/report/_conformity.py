"""Levels judged by dated rules: at the rule's own set-up only, by section, with the uncertainty.

Decision rule (ILAC-G8:09/2019, JCGM 106:2012), guard band as wide as the expanded uncertainty U: conforms
where value + U is within the limit, does not conform where value - U exceeds it, otherwise inconclusive.
U combines the scatter between balls of the series (type A), the uncertainty of measured aerodynamics and what
the plan states of the measurement ([rules.uncertainty]); its coverage factor follows Welch and Satterthwaite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from enum import StrEnum
from math import hypot, inf, sqrt
from typing import NamedTuple

import numpy as np
from scipy import stats

from bench.campaign.plan.conformity_rules import UNITS_OF_RULES, RuleSet, rule_on
from bench.campaign.plan.plan import FLOWN, CampaignPlan, SetUp, stated_uncertainties
from bench.campaign.plan.shot_sequence import Role, Section, sections, tests_by_level
from bench.campaign.report.report_format import DisplayUnit, UnitSystem, display_unit
from bench.campaign.statistics.sample_size import share_done
from bench.records.shot.shot import Shot, ShotStatus

COVERAGE = 0.95449973610364
"""Probability within U: that of two standard deviations."""

DECISION_RULE = (
    "Decision rule: conforms where value + U is within the limit, does not conform where value − U exceeds "
    "it, otherwise inconclusive (guard band U, expanded uncertainty at 95.45 %; ILAC-G8:09/2019, JCGM 106)."
)


class Decision(StrEnum):
    """Decision on a level by a rule."""

    CONFORMS = "conforms"
    FAILS = "does not conform"
    INCONCLUSIVE = "inconclusive"
    NOT_JUDGED = "not judged"


@dataclass(frozen=True)
class RuleFinding:
    """One level of one section judged by one dated rule set."""

    rule: str
    text: str
    section: int
    section_name: str
    level: str
    """Names of the levels for a difference."""
    value: float | None
    """Mean over the balls in the rule's unit, or max difference; None without valid shots."""
    unit: str
    at_most: float
    uncertainty: float | None
    """Expanded uncertainty U in the rule's unit; None if not judged."""
    coverage: float | None
    decision: Decision
    reason: str
    """Reason for a missing assessment, or limitation of the decision; empty without one."""
    confidence: str
    source: str

    def words_in(self, units: UnitSystem) -> str:
        """Return the finding as one sentence, in the rule's unit and the reader's `units`; without source."""
        where = f"section {self.section} ({self.section_name}), " if self.section_name else ""
        head = f"{self.text} ({self.rule}): {where}{self.level}"
        if self.decision is Decision.NOT_JUDGED or self.value is None or self.uncertainty is None:
            return f"{head} – {self.decision}: {self.reason}."
        tail = f" {self.reason}." if self.reason else ""
        mean, most, beside = f"{self.value:.1f} ± {self.uncertainty:.1f}", f"{self.at_most:.1f}", ""
        if (reader := display_unit(_LIKE[self.unit], units)).unit != self.unit:
            size = UNITS_OF_RULES[self.unit] / reader.size
            beside = (
                f" ({size * self.value:.1f} ± {size * self.uncertainty:.1f}, at most "
                f"{size * self.at_most:.1f} {reader.unit})"
            )
        return (
            f"{head}, {mean} {self.unit} (k = {self.coverage:.2f}), at most {most} {self.unit}{beside} – "
            f"{self.decision}.{tail}"
        )


_LIKE = {"yd": "carry_m", "ft/s": "ball_speed_mps"}
"""Quantity of the same kind by the unit of a rule."""


class _Mean(NamedTuple):
    """Mean over the balls of a level, with its standard uncertainty from their scatter."""

    value: float
    error: float
    dof: float
    balls: int
    coefficients: float
    """Standard uncertainty from measured aerodynamics."""


class _Unjudged(Exception):
    """A rule does not judge; the text gives the reason."""


def judge_rules(
    plan: CampaignPlan, shots: Sequence[Shot], units: UnitSystem = UnitSystem.SI
) -> list[RuleFinding]:
    """Return the findings of the plan's rules for each level and section; reasons have values in `units`."""
    found: list[RuleFinding] = []
    for section in sections(plan):
        mine = [s for s in shots if s.section == section.number and s.role != Role.WARM_UP]
        if not mine:
            continue
        day, seen = max(shot.time_utc for shot in mine).date(), set[str]()
        for name in plan.rules.apply:
            rule = rule_on(name, day)
            if rule is not None and rule.name not in seen:
                seen.add(rule.name)
                found += _judged(plan, section, rule, mine, day, units)
    return found


def _judged(
    plan: CampaignPlan, section: Section, rule: RuleSet, shots: Sequence[Shot], day: date, units: UnitSystem
) -> list[RuleFinding]:
    groups = tests_by_level(plan, (s for s in shots if s.status is ShotStatus.VALID))
    if rule.difference:
        return [_finding(plan, section, rule, shots, day, groups, units)]
    return [_finding(plan, section, rule, shots, day, {name: group}, units) for name, group in groups.items()]


def _finding(
    plan: CampaignPlan,
    section: Section,
    rule: RuleSet,
    shots: Sequence[Shot],
    day: date,
    groups: dict[str, list[Shot]],
    units: UnitSystem,
) -> RuleFinding:
    value = uncertainty = coverage = None
    decision, reason = Decision.NOT_JUDGED, ""
    try:
        means = {name: _mean(rule, group) for name, group in groups.items()}
        value = _value(rule, means) / rule.scale
        _require_end(plan, shots)
        controls = [s for s in shots if s.role == Role.CONTROL and s.status is ShotStatus.VALID]
        _require_set_up(rule, plan.set_up, controls, units)
        _require_source(rule, [shot for group in groups.values() for shot in group])
        error, dof = _combined(plan, rule, list(means.values()))
        coverage = float(stats.t.ppf((1 + COVERAGE) / 2, dof))
        uncertainty = coverage * error / rule.scale
        decision = decide_by_limit(value, uncertainty, rule.at_most)
        reason = _reservation(rule, day, means)
    except _Unjudged as why:
        reason = str(why)
    return RuleFinding(
        rule=rule.name,
        text=rule.text,
        section=section.number,
        section_name=section.name if len(sections(plan)) > 1 else "",
        level=" against ".join(groups),
        value=value,
        unit=rule.unit,
        at_most=rule.at_most,
        uncertainty=uncertainty,
        coverage=coverage,
        decision=decision,
        reason=reason,
        confidence=rule.confidence,
        source=rule.source,
    )


def decide_by_limit(value: float, uncertainty: float, at_most: float) -> Decision:
    """Return the decision with a guard band of the expanded `uncertainty`; all in one unit."""
    if value + uncertainty <= at_most:
        return Decision.CONFORMS
    return Decision.FAILS if value - uncertainty > at_most else Decision.INCONCLUSIVE


def _mean(rule: RuleSet, shots: Sequence[Shot]) -> _Mean:
    """Return the mean of the ball means; shots of balls that are not distinguished count as balls each."""
    by_ball: dict[int, list[float]] = {}
    for number, shot in enumerate(shots):
        value = getattr(shot, rule.quantity)
        if value is not None:
            by_ball.setdefault(shot.sample or -1 - number, []).append(value)
    values = [value for one in by_ball.values() for value in one]
    if len(values) < 2:
        raise _Unjudged(f"{len(values)} valid shots with {rule.quantity}, at least 2 needed")
    means = [float(np.mean(one)) for one in by_ball.values()] if len(by_ball) > 1 else values
    errors = [e for s in shots if (e := s.carry_measured_error_m) is not None]
    flown = rule.quantity in FLOWN and any(_source_of(rule, s) == "measured" for s in shots)
    return _Mean(
        float(np.mean(means)),
        float(np.std(means, ddof=1)) / sqrt(len(means)),
        len(means) - 1,
        len(by_ball),
        float(np.mean(errors)) if flown and errors else 0.0,
    )


def _value(rule: RuleSet, means: dict[str, _Mean]) -> float:
    values = [mean.value for mean in means.values()]
    if not rule.difference:
        return values[0]
    if len(values) < 2:
        raise _Unjudged("one level only, nothing to compare")
    return max(values) - min(values)


def _require_end(plan: CampaignPlan, shots: Sequence[Shot]) -> None:
    """Raise _Unjudged before the end of a section whose size is fixed: each look would be another chance."""
    share = share_done(plan, shots)
    if plan.stop.rule == "fixed" and share < 1 - 1e-9:
        raise _Unjudged(f"the section is not finished, {100 * share:.0f} % of its shots are done")


def _require_set_up(rule: RuleSet, given: SetUp, controls: Sequence[Shot], units: UnitSystem) -> None:
    """Raise _Unjudged unless the control ball was launched as the rule's set-up says."""
    if rule.apparatus:
        raise _Unjudged(rule.apparatus)
    if (wanted := rule.set_up) is None:
        return
    if not controls:
        raise _Unjudged("no control ball shows that the set-up is the rule's")
    speed = wanted.ball_speed_by(given.control_restitution, given.control_contact_time)
    wrong = []
    angle = wanted.launch_angle_deg, wanted.launch_angle_window_deg
    for name, column, middle, window, digits in (
        ("ball speed", "ball_speed_mps", speed, wanted.ball_speed_window, 1),
        ("launch angle", "launch_angle_deg", *angle, 1),
        ("spin", "spin_rpm", wanted.spin_rpm, wanted.spin_window_rpm, 0),
    ):
        values = [value for shot in controls if (value := getattr(shot, column)) is not None]
        unit: DisplayUnit = display_unit(column, units)
        rule_words = f"rule {unit.of(middle):.{digits}f} ± {unit.of(window):.{digits}f} {unit.unit}"
        if not values:
            wrong.append(f"{name} of the control ball not measured, {rule_words}")
        elif abs(float(np.mean(values)) - middle) > window:
            wrong.append(f"{name} {unit.of(float(np.mean(values))):.{digits}f} {unit.unit}, {rule_words}")
    if wrong:
        raise _Unjudged("; ".join(wrong))


def _require_source(rule: RuleSet, shots: Sequence[Shot]) -> None:
    """Raise _Unjudged where the flight is not that of the ball that was hit."""
    if rule.quantity not in FLOWN:
        return
    wrong = sorted({_source_of(rule, shot) for shot in shots} - {"measured", "monitor", "simulated"})
    if wrong:
        raise _Unjudged(f"{rule.quantity} from {wrong[0] or 'no source'}, not of the ball that was hit")


def _source_of(rule: RuleSet, shot: Shot) -> str:
    return shot.carry_source if rule.quantity == "carry_m" else shot.flight_source or shot.carry_source


def _combined(plan: CampaignPlan, rule: RuleSet, means: Sequence[_Mean]) -> tuple[float, float]:
    """Return standard uncertainty and effective degrees of freedom (Welch and Satterthwaite)."""
    stated = [one.uncertainty for one in stated_uncertainties(plan, rule.quantity)]
    if rule.difference:
        stated = [0.0]  # common to both levels
    if not stated:
        where = "rules.uncertainty or calibrations in the plan"
        raise _Unjudged(f"the uncertainty of {rule.quantity} is not stated ({where})")
    scatter = sum(mean.error**4 / mean.dof for mean in means)
    error = hypot(hypot(*stated), *(mean.error for mean in means), *(mean.coefficients for mean in means))
    return error, error**4 / scatter if scatter else inf


def _reservation(rule: RuleSet, day: date, means: dict[str, _Mean]) -> str:
    words = []
    if not rule.in_force(day):
        words.append(f"Not in force on {day}: {rule.begins} to {rule.ends}")
    if one := [name for name, mean in means.items() if mean.balls == 1]:
        words.append(f"One ball of {', '.join(one)} was hit: it is judged, not its model")
    return ". ".join(words)
