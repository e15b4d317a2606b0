"""The answers of a campaign in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from bench.campaign.analysis import Comparison, Pair, SectionAnalysis, shots_still_needed
from bench.campaign.page import MPH
from bench.campaign.plan import FLOWN, CampaignPlan, levels
from bench.campaign.preview import UNITS
from bench.campaign.repeatability import Repeatability

NAMES = {
    "carry_m": "carry",
    "total_m": "total distance",
    "ball_speed_mps": "ball speed",
    "club_speed_mps": "club speed",
    "launch_angle": "launch angle",
    "landing_angle": "landing angle",
    "spin_rpm": "spin",
}
"""Names of the quantities in sentences."""


_CARRIES = {
    "reference": " (reference ball)",
    "monitor": " (launch monitor)",
    "measured": " (measured aerodynamics)",
}


def quantity_name(plan: CampaignPlan) -> str:
    """Return the name of the compared quantity in sentences; of a flight with whose it is."""
    a = plan.analysis
    return NAMES[a.quantity] + (_CARRIES.get(a.carry, "") if a.quantity in FLOWN else "")


class Verdict(NamedTuple):
    """The answer to one comparison, in words."""

    resolved: bool
    headline: str
    detail: str


def section_verdicts(plan: CampaignPlan, analysis: SectionAnalysis) -> tuple[Verdict, ...]:
    """Return one answer for one pair; for more, one for all pairs and one for each resolved pair."""
    name = quantity_name(plan)
    if len(levels(plan)) < 2:
        level = analysis.levels[0]
        s, unit = level.spread, UNITS[plan.analysis.quantity]
        if s.n < 2:
            return (Verdict(False, f"Too few valid shots to describe {level.name}.", f"{s.n} valid shots."),)
        return (
            Verdict(
                True,
                f"{level.name}: {name} {s.mean:.2f} {unit}, one shot scatters by {s.deviation:.2f} {unit}.",
                f"95 % interval of the mean {s.low:.2f} to {s.high:.2f}, of the standard deviation "
                f"{s.deviation_low:.2f} to {s.deviation_high:.2f} {unit}; {s.n} valid shots. One level only: "
                "nothing is compared.",
            ),
        )
    comparison = analysis.confirmatory
    if comparison is None or not comparison.pairs:
        text = "Each needs valid shots in at least two blocks that it shares with another."
        return (Verdict(False, f"Too few valid shots to compare {plan.design.compare}s.", text),)
    if len(comparison.pairs) == 1:
        return (_pair(plan, comparison, comparison.pairs[0]),)
    count = Counter(pair.verdict for pair in comparison.pairs)
    different = count["different"] + count["both"]
    headline = f"{different} of {len(comparison.pairs)} pairs differ in {name}"
    if count["same"]:
        headline += f", {count['same']} are the same within {_margin(plan)}"
    open_ = count["not enough shots"] + count["open"]
    if open_:
        headline += f", for {open_} there are not enough shots"
    means = sorted((level.spread.mean, level.name) for level in analysis.levels if level.spread.n)
    (least, last), (most, first) = means[0], means[-1]
    detail = (
        f"Most has {first}, {most:.2f} {UNITS[plan.analysis.quantity]}, least {last}, {least:.2f} "
        f"{UNITS[plan.analysis.quantity]}. All pairs together at {100 * plan.analysis.confidence:g} % (Holm)"
    )
    needed, _ = shots_still_needed(plan, comparison)
    if open_ and needed:
        detail += (
            f"; a difference of {plan.analysis.difference:g} {UNITS[plan.analysis.quantity]} would need "
            f"{needed} valid shots of each"
        )
    return (Verdict(not open_, f"{headline}.", f"{detail}. Every pair is in the table below."),)


def _pair(plan: CampaignPlan, comparison: Comparison, pair: Pair) -> Verdict:
    a, unit, name = plan.analysis, UNITS[plan.analysis.quantity], quantity_name(plan)
    seen = (
        f"Difference {pair.first} − {pair.second}: {_signed(pair.difference)} {unit}, "
        f"{100 * a.confidence:g} % interval {_signed(pair.low)} to {_signed(pair.high)} {unit}; "
        f"at least {pair.shots} valid shots of each, one shot scatters by {comparison.deviation:.2f} {unit} "
        "(SD)."
    )
    match pair.verdict:
        case "different" | "both":
            ahead, behind = (pair.first, pair.second) if pair.difference > 0 else (pair.second, pair.first)
            less = f", though by less than {_margin(plan)}" if pair.verdict == "both" else ""
            headline = f"{ahead} has {abs(pair.difference):.2f} {unit} more {name} than {behind}{less}."
            return Verdict(True, headline, seen)
        case "same":
            headline = f"{pair.first} and {pair.second} are the same in {name}, within {_margin(plan)}."
            return Verdict(True, headline, seen)
        case "open":
            return Verdict(
                True,
                f"No difference in {name} between {pair.first} and {pair.second} was found.",
                f"{seen} One of {a.difference:g} {unit} would have been seen with a chance of "
                f"{100 * pair.power:.0f} %.",
            )
        case _:
            outlook = []
            different, same = shots_still_needed(plan, comparison)
            if different:
                outlook.append(
                    f"about {different} valid shots of each to find a difference of {a.difference:g} {unit}"
                )
            if same:
                outlook.append(f"about {same} to call them the same within {_margin(plan)}")
            wanted = " and ".join(outlook)
            return Verdict(
                False,
                f"Not enough shots to tell whether {pair.first} and {pair.second} differ in {name}.",
                f"{seen} With this scatter it takes {wanted} ({100 * a.power:.0f} % chance).",
            )


def _margin(plan: CampaignPlan) -> str:
    return f"{plan.analysis.margin:g} {UNITS[plan.analysis.quantity]}"


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−")


def robot_words(delivered: Mapping[tuple[str, str], Sequence[Repeatability]]) -> str:
    """Return the robot's repeatability of club speed, a sentence for each swing and club."""
    words = []
    for (swing, club), figures in delivered.items():
        speed = next((f for f in figures if f.column == "club_speed_mps" and f.n > 1), None)
        if speed is not None:
            where = f" with {club}, {swing}" if len(delivered) > 1 else ""
            deviation = speed.overall.deviation
            words.append(
                f"The robot delivered {speed.mean:.2f} m/s ({speed.mean / MPH:.1f} mph) of club speed{where} "
                f"with a standard deviation of {deviation:.3f} m/s ({100 * deviation / speed.mean:.2f} %) "
                f"over {speed.n} valid shots."
            )
    return " ".join(words) or "Fewer than two valid shots: the robot's repeatability is not known."
