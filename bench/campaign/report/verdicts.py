"""The answers of a campaign in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from math import ceil, log10, sqrt
from typing import NamedTuple

import numpy as np

from bench.campaign.plan.plan import FLOWN, NAMES, CampaignPlan, levels
from bench.campaign.report.preview import series_words
from bench.campaign.report.report_format import MPH, DisplayUnit, UnitSystem, display_unit, two_digits
from bench.campaign.statistics.analysis import Comparison, Covariates, Pair, SectionAnalysis
from bench.campaign.statistics.block_model import Repeatability, successive_scatter
from bench.campaign.statistics.sample_size import SeriesSize, series_needed

_CARRIES = {
    "reference": " (reference ball)",
    "monitor": " (launch monitor)",
    "measured": " (measured aerodynamics)",
}


def quantity_name(plan: CampaignPlan) -> str:
    """Return the display name of the compared quantity; for a flight it includes the source of its carry."""
    a = plan.analysis
    return NAMES[a.quantity] + (_CARRIES.get(a.carry, "") if a.quantity in FLOWN else "")


_NAMED = 3
"""Max number of differing pairs that a headline names."""
_LIMIT = 2.8
"""Repeatability limit over standard deviation: 1.96 times the square root of 2."""


class Verdict(NamedTuple):
    """The answer to one comparison, in words."""

    resolved: bool
    headline: str
    detail: str


Needed = tuple[SeriesSize | None, SeriesSize | None]
"""SeriesSize that finds a difference, and that calls equal levels the same."""


def section_verdicts(
    plan: CampaignPlan, analysis: SectionAnalysis, needed: Needed, units: UnitSystem = UnitSystem.SI
) -> tuple[Verdict, ...]:
    """Return one answer for one pair, one for all pairs of more, figures in `units`."""
    unit = display_unit(plan.analysis.quantity, units)
    if len(levels(plan)) < 2:
        return (_one_level(plan, analysis, unit),)
    comparison = analysis.confirmatory
    if comparison is None or not comparison.pairs:
        text = "Each needs valid shots in at least two blocks that it shares with another."
        if plan.split:
            text = "Each needs at least two mountings, in blocks that it shares with others."
        return (Verdict(False, f"Too few valid shots to compare {plan.design.compare}s.", text),)
    if len(comparison.pairs) == 1:
        return (_pair(plan, analysis, comparison, comparison.pairs[0], needed, unit),)
    return (_all_pairs(plan, analysis, comparison, needed, unit),)


def section_notes(
    plan: CampaignPlan, analysis: SectionAnalysis, needed: Needed, units: UnitSystem = UnitSystem.SI
) -> tuple[str, ...]:
    """Return what stands under a section's pairs: its look, its covariates, what more shots would do."""
    comparison, a = analysis.confirmatory, plan.analysis
    unit = display_unit(a.quantity, units)
    if comparison is None or not comparison.pairs:
        return ()
    notes = []
    if comparison.covariates is not None:
        notes.append(_covariate_words(plan, comparison, comparison.covariates, needed[0], unit))
    if needed[0] is not None:
        words = (
            f"With this scatter {series_words(needed[0], plan)} find a difference of "
            f"{_size_in(a.target_difference, unit)} with a chance of {100 * a.power:.0f} %"
        )
        if needed[1] is not None:
            words += (
                f", {series_words(needed[1], plan)} call equal ones the same within {_margin(plan, unit)}"
            )
        notes.append(f"{words}.")
    else:
        notes.append(
            f"With this scatter it takes too many shots to find {_size_in(a.target_difference, unit)}."
        )
    return tuple(notes)


def confidence_words(confidence: float) -> str:
    """Return a level in percent with as many digits as it needs; never rounded up to 100."""
    error = 100 * (1 - confidence)
    if error < 1e-6:
        return "> 99.999999"
    digits = max(1, ceil(-log10(error)) + 1)
    return f"{100 - error:.{digits}f}".rstrip("0").rstrip(".")


def _one_level(plan: CampaignPlan, analysis: SectionAnalysis, unit: DisplayUnit) -> Verdict:
    name, level, of = quantity_name(plan), analysis.levels[0], unit.of
    s, levels_ = level.spread, confidence_words(plan.analysis.confidence)
    if s.n < 2:
        return Verdict(False, f"Too few valid shots to describe {level.name}.", f"{s.n} valid shots.")
    whose = f"with {s.balls} balls" if s.balls > 1 else "with one ball, for which it holds"
    detail = (
        f"{levels_} % interval of the mean {of(s.low):.2f} to {of(s.high):.2f}, of the standard deviation "
        f"{of(s.sd_low):.2f} to {of(s.sd_high):.2f} {unit.unit}; {s.n} valid shots {whose}."
    )
    if len(analysis.values) > 2:
        found = successive_scatter(np.array(analysis.values), plan.analysis.confidence)
        low, high, limit = of(found.low), of(found.high), _LIMIT * of(found.sd)
        detail += (
            f" Repeatability from shot to shot: standard deviation {of(found.sd):.3f} {unit.unit} "
            f"({levels_} % interval {low:.3f} to {high:.3f}); two successive shots differ by less than "
            f"{limit:.3f} {unit.unit} 95 times in 100 (repeatability limit, ISO 5725-6)."
        )
    return Verdict(
        True,
        f"{level.name}: {name} {of(s.mean):.2f} {unit.unit}, one shot scatters by {_sd(of(s.sd))} "
        f"{unit.unit}.",
        f"{detail} One level only: nothing is compared.",
    )


def _all_pairs(
    plan: CampaignPlan, analysis: SectionAnalysis, comparison: Comparison, needed: Needed, unit: DisplayUnit
) -> Verdict:
    name, of = quantity_name(plan), unit.of
    count, pairs = Counter(pair.verdict for pair in comparison.pairs), len(comparison.pairs)
    same, open_ = count["same"] + count["both"], count["open"] + count["not enough shots"]
    things = f"{plan.design.compare}s"
    if same == pairs:
        headline = f"All {len(levels(plan))} {things} are the same in {name}, within {_margin(plan, unit)}"
        if count["both"]:
            headline += f" ({_of(count['both'], pairs)} {_differ(count['both'])}, by less than that)"
    else:
        differ, alike = count["different"] + count["both"], count["same"]
        headline = f"{_of(differ, pairs)} {_differ(differ)} in {name}"
        if count["both"]:
            how_many = f"{count['both']} of them " if count["different"] else ""
            headline += f", {how_many}by less than {_margin(plan, unit)}"
        if named := 0 < differ <= _NAMED:
            headline += f": {_longer(comparison.pairs)}"
        then = "; " if named else ", "
        if alike:
            headline += f"{then}{alike} {'are' if alike > 1 else 'is'} the same within {_margin(plan, unit)}"
        if count["open"]:
            what = (
                "neither different nor the same" if plan.analysis.equivalence_margin else "not seen to differ"
            )
            headline += f"{then}{count['open']} {'are' if count['open'] > 1 else 'is'} {what}"
        if count["not enough shots"]:
            headline += f"{then}for {count['not enough shots']} there are not enough shots"
    means = sorted((level.spread.mean, level.name) for level in analysis.levels if level.spread.n)
    (least, last), (most, first) = means[0], means[-1]
    detail = (
        f"Highest mean {of(most):.2f} {unit.unit} ({first}), lowest {of(least):.2f} {unit.unit} ({last}); "
        "the order is not tested. "
        f"{_size(plan, comparison.pairs)} All pairs together at {confidence_words(comparison.confidence)} %"
    )
    if count["not enough shots"] and needed[0]:
        wanted = _size_in(plan.analysis.target_difference, unit)
        detail += f"; a difference of {wanted} would need {series_words(needed[0], plan)}"
    detail = f"{detail.rstrip(',')}. {_validity(plan, comparison.pairs)}{_look(analysis)}"
    return Verdict(not open_, f"{headline}.", f"{detail}All {pairs} pairs with intervals: table of pairs.")


def _longer(pairs: Sequence[Pair]) -> str:
    apart = [pair for pair in pairs if pair.verdict in {"different", "both"}]
    ordered = [(p.first, p.second) if p.difference > 0.0 else (p.second, p.first) for p in apart]
    return ", ".join(f"{higher} > {lower}" for higher, lower in ordered)


def _of(number: int, pairs: int) -> str:
    return f"{'None' if not number else number} of {pairs} pairs"


def _differ(number: int) -> str:
    return "differs" if number == 1 else "differ"


def _size(plan: CampaignPlan, pairs: Sequence[Pair]) -> str:
    """Return the number of shots, and of balls, of the level with fewest."""
    shots, balls = min(pair.shots for pair in pairs), min(pair.balls for pair in pairs)
    if plan.split:
        return f"At least {shots} valid shots of each in {balls} mountings, by which clubs are judged."
    if plan.design.compare != "ball":
        return f"At least {shots} valid shots of each."
    return f"At least {shots} valid shots of each with {balls} ball{'s' if balls > 1 else ''}."


def _validity(plan: CampaignPlan, pairs: Sequence[Pair]) -> str:
    """Return a sentence that limits a verdict to specimens; empty without such a limit."""
    if plan.design.compare == "club":
        return "It holds for these clubs, one of each: others of their models were not hit. "
    if plan.design.compare == "ball" and not all(pair.models for pair in pairs):
        some = "" if not any(pair.models for pair in pairs) else "Where a level has one ball: "
        return f"{some or 'One ball of a level: '}it holds for this ball, not for its model. "
    return ""


def _look(analysis: SectionAnalysis) -> str:
    look = analysis.look
    if look.share >= 1:
        return f"Analysis no. {look.number}, allowing for the earlier ones. " if look.number > 1 else ""
    return (
        f"Interim analysis no. {look.number} has {100 * look.share:.0f} % of the plan's shots; the others "
        f"are excluded or still to come. The significance level is {100 * look.alpha:.2g} %, so that all "
        "analyses together keep the plan's. "
    )


def _pair(
    plan: CampaignPlan,
    analysis: SectionAnalysis,
    comparison: Comparison,
    pair: Pair,
    needed: Needed,
    unit: DisplayUnit,
) -> Verdict:
    a, name, of = plan.analysis, quantity_name(plan), unit.of
    between, ahead, behind, low, high = comparison.ball_sd, pair.first, pair.second, pair.low, pair.high
    if pair.difference < 0.0:
        ahead, behind, low, high = behind, ahead, -high, -low
    seen = (
        f"Difference {ahead} − {behind}: {_signed(of(abs(pair.difference)))} {unit.unit}, "
        f"{confidence_words(comparison.confidence)} % interval {_signed(of(low))} to "
        f"{_signed(of(high))} {unit.unit}. {_size(plan, [pair])} One shot scatters by "
        f"{_sd(of(comparison.sd))} {unit.unit} (SD)"
    )
    groups = "mountings of one club" if plan.split else "balls of one model"
    seen += "" if between is None else f", {groups} by {_sd(of(between))} {unit.unit}"
    match pair.verdict:
        case "different" | "both":
            less = f", though by less than {_margin(plan, unit)}" if pair.verdict == "both" else ""
            headline = (
                f"{ahead} has {abs(of(pair.difference)):.2f} {unit.unit} more {name} than {behind}{less}."
            )
        case "same":
            headline = f"{pair.first} and {pair.second} are the same in {name}, within {_margin(plan, unit)}."
        case "open":
            headline = f"No difference in {name} between {pair.first} and {pair.second} was found."
            if a.equivalence_margin:
                headline = f"{headline[:-1]}, nor that they are the same within {_margin(plan, unit)}."
            seen += (
                f". One of {_size_in(a.target_difference, unit)} would have been seen with a chance of "
                f"{100 * pair.power:.0f} %"
            )
        case _:
            headline = f"Not enough shots to decide whether {pair.first} and {pair.second} differ in {name}."
            different, same = needed
            outlook = []
            if different:
                outlook.append(
                    f"about {series_words(different, plan)} to find a difference of "
                    f"{_size_in(a.target_difference, unit)}"
                )
            if same:
                outlook.append(
                    f"about {series_words(same, plan)} to call them the same within {_margin(plan, unit)}"
                )
            wanted = " and ".join(outlook) or "too many shots to name"
            seen += f". With this scatter it takes {wanted} ({100 * a.power:.0f} % chance)"
    detail = f"{seen}. {_validity(plan, [pair])}{_look(analysis)}".strip()
    return Verdict(pair.verdict != "not enough shots", headline, detail)


def _covariate_words(
    plan: CampaignPlan,
    comparison: Comparison,
    found: Covariates,
    needed: SeriesSize | None,
    unit: DisplayUnit,
) -> str:
    names = ", ".join(NAMES[name] for name in found.names)
    words = f"Corrected by {names}, as planned: it explains {100 * found.share:.0f} % of a shot's variance"
    plain = comparison.sd / sqrt(max(1 - found.share, 1e-6))
    without, _ = series_needed(plan, plain, comparison.ball_sd or 0.0)
    if needed is not None and without is not None:
        words += (
            f"; without it {without.shots} valid shots of each, not {needed.shots}, would be needed for "
            f"{_size_in(plan.analysis.target_difference, unit)}"
        )
    missed = f" {found.missing} valid shots without it are left out." if found.missing else ""
    return f"{words}.{missed}"


def _margin(plan: CampaignPlan, unit: DisplayUnit) -> str:
    return _size_in(plan.analysis.equivalence_margin, unit)


def _size_in(size: float, unit: DisplayUnit) -> str:
    return f"{unit.of(size):.4g} {unit.unit}" if unit.size != 1 else f"{size:g} {unit.unit}"


def _sd(value: float) -> str:
    """Return a standard deviation with two decimals; a small one with two significant digits."""
    return f"{value:.2f}" if value >= 0.1 or not value else two_digits(value)


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−")


def robot_words(delivered: Mapping[tuple[str, str], Sequence[Repeatability]]) -> str:
    """Return the robot's repeatability of club speed, a sentence for each swing and club."""
    words = []
    for (swing, club), figures in delivered.items():
        speed = next((f for f in figures if f.column == "club_speed_mps" and f.n > 1), None)
        if speed is not None:
            where = f" with {club}, {swing}" if len(delivered) > 1 else ""
            sd = speed.overall.sd
            words.append(
                f"The robot delivered {speed.mean:.2f} m/s ({speed.mean / MPH:.1f} mph) of club speed{where} "
                f"with a standard deviation of {sd:.3f} m/s ({100 * sd / speed.mean:.2f} %) "
                f"over {speed.n} valid shots."
            )
    return " ".join(words) or "Fewer than two valid shots: the robot's repeatability is not known."
