"""Output of `golfbench campaign check` before anything moves: shot order, hits, resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, groupby, pairwise
from math import hypot, sqrt
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bench.campaign.plan.bench_setup import LoadList, load_lists
from bench.campaign.plan.plan import NAMES, CampaignPlan, levels
from bench.campaign.plan.shot_sequence import PlannedShot, Role, all_trials, hits_needed, is_mounted, sections
from bench.campaign.report.report_format import display_unit
from bench.campaign.statistics.block_model import within_club
from bench.campaign.statistics.sample_size import (
    SeriesSize,
    alpha_at_end,
    balls_of_each,
    predict_precision,
    series_needed,
)
from bench.store.rows import Hit, places

_SHOWN = 3
"""Number of blocks printed of each section without --all."""


@dataclass(frozen=True)
class Outlook:
    """Resolution of one section of a plan; figures in the quantity's unit, None if unknown."""

    levels: int
    pairs: int
    blocks: int
    dof: float
    alpha: float
    """Significance level of each pair, at which all pairs together keep the confidence."""
    power: float | None
    """Power to find the difference worth finding, in one pair."""
    resolution: float | None
    """Difference that is found with the planned power."""
    needed: int | None
    """Valid shots of each level for the planned power."""
    balls: int | None
    """Balls of each level that they are hit with; 0 where the level is no ball."""
    without: int | None
    """Valid shots of each level that it would take without the covariates; None without any."""
    same: float | None
    """Probability to call equal levels the same."""


def outlook(plan: CampaignPlan) -> Outlook:
    """Return the resolution of a section of `plan` after all its blocks, with all shots valid."""
    a, count, blocks = plan.analysis, len(levels(plan)), plan.design.blocks
    pairs, alpha = len(list(combinations(range(count), 2))), alpha_at_end(plan)
    sd = a.expected_sd * sqrt(1 - (a.expected_r_squared if a.covariates else 0.0))
    between = a.mounting_sd if plan.split else a.ball_sd
    if plan.design.compare == "club" and not plan.split and sd:
        sd = hypot(sd, a.mounting_sd)  # nearly each shot has a separate mounting
    known = predict_precision(plan, sd or 1.0, between)
    if known is None or not a.expected_sd:
        dof = known.dof if known else 0.0
        return Outlook(count, pairs, blocks, dof, alpha / max(pairs, 1), *[None] * 6)
    needed, _ = series_needed(plan, sd, between)
    plain, _ = series_needed(plan, a.expected_sd, a.ball_sd) if a.covariates else (None, None)
    return Outlook(
        count,
        pairs,
        blocks,
        known.dof,
        known.single,
        known.power(a.target_difference),
        known.resolution(a.power),
        needed and needed.shots,
        needed and needed.balls,
        plain and plain.shots,
        known.same(a.equivalence_margin, alpha) if a.equivalence_margin else None,
    )


def preview_record(plan: CampaignPlan, hits: Mapping[Hit, int]) -> dict[str, Any]:
    """Return the output of `check` for JSON; `hits` are those that its balls have taken before."""
    trials = all_trials(plan)
    return {
        "name": plan.campaign.name,
        "digest": plan.digest,
        "seed": plan.design.seed,
        "shots": len(trials),
        "warm_up_at_most": plan.warm_up.at_most * len(sections(plan)),
        "expected_duration_s": len(trials) * plan.design.seconds_per_shot,
        "hits": hits_needed(plan),
        "outlook": vars(outlook(plan)),
        "sequence": [_trial_record(trial) for trial in trials],
        "loads": [
            {"before": _trial_record(load.before), "balls": load.balls} for load in load_lists(plan, hits)
        ],
        "hand_work": hand_work(plan, hits),
        "outlook_words": outlook_words(plan),
    }


def hand_work(plan: CampaignPlan, hits: Mapping[Hit, int]) -> list[dict[str, Any]]:
    """Return the planned work by hand: `shot`, the number of the planned shot it precedes, and `text`.

    As if every shot were valid and each warm-up the shortest; the first club is taken as mounted.
    """
    trials = all_trials(plan)
    numbers = {(trial.block, trial.position): number for number, trial in enumerate(trials, 1)}
    found = []
    for number, (before, trial) in enumerate(pairwise(trials), 2):
        if not is_mounted(plan, before, trial):
            one, two = before.arm.club, trial.arm.club
            again = f"Take club {two} off and mount it again"
            found.append((number, 0, again if one == two else f"Mount club {two} in place of {one}"))
    for load in load_lists(plan, hits):
        before, text = load.before, f"Fill the feeder: {', '.join(places(load.balls))}"
        first = next(n for n, trial in enumerate(trials, 1) if trial.section == before.section)  # a warm-up
        found.append((numbers.get((before.block, before.position), first), 1, text))
    return [{"shot": number, "text": text} for number, _, text in sorted(found)]


def _trial_record(trial: PlannedShot) -> dict[str, Any]:
    return {name: value for name, value in trial._asdict().items() if name != "arm"} | trial.arm._asdict()


def show_preview(
    plan: CampaignPlan, hits: Mapping[Hit, int], console: Console, *, everything: bool = False
) -> None:
    """Print the plan's order, load lists, hits and resolution; the first blocks only unless `everything`.

    `hits` are those that its balls have taken before.
    """
    d, trials = plan.design, all_trials(plan)
    hours = len(trials) * d.seconds_per_shot / 3600
    console.print(f"[bold]{escape(plan.campaign.title or plan.campaign.name)}[/]", highlight=False)
    console.print(
        f"{len(trials)} shots in {len(sections(plan)) * d.blocks} blocks, order from seed {d.seed}; about "
        f"{hours:.1f} h at {d.seconds_per_shot:g} s a shot. Warm-up: {_warm_up(plan)}.",
        highlight=False,
    )
    for section in sections(plan):
        title = f"Section {section.number}: {section.name or 'one arm'}"
        table = Table("block", "order", title=title, title_justify="left")
        mine = [trial for trial in trials if trial.section == section.number]
        blocks = [(number, list(group)) for number, group in groupby(mine, key=lambda t: t.block)]
        for number, group in blocks if everything else blocks[:_SHOWN]:
            table.add_row(str(number), _order(plan, group))
        if len(blocks) > _SHOWN and not everything:
            table.add_row("...", f"{len(blocks) - _SHOWN} more blocks (--all shows them)")
        console.print(table)
    if loads := load_lists(plan, hits):
        console.print(_load_table(plan, loads, everything=everything))
    table = Table(
        "ball", "hits", "balls × hits allowed", title="Hits at most, repeats left out", title_justify="left"
    )
    for name, number in hits_needed(plan).items():
        handling = plan.ball_handling
        table.add_row(escape(name), str(number), f"{handling.samples} × {handling.hits}")
    console.print(table)
    for line in outlook_words(plan):
        console.print(line, highlight=False, markup=False)


def _load_table(plan: CampaignPlan, loads: Sequence[LoadList], *, everything: bool) -> Table:
    title = f"Load lists: a magazine of {plan.ball_handling.magazine}, the first ball to be hit at place 1"
    table = Table("load", "before", "place and ball", title=title, title_justify="left")
    for number, load in enumerate(loads, 1):
        if number > _SHOWN and not everything:
            table.add_row("...", "", f"{len(loads) - _SHOWN} more (--all shows them)")
            break
        before = load.before
        where = f"block {before.block}, shot {before.position}" if before.block else "warm-up"
        table.add_row(str(number), where, escape("  ".join(places(load.balls))))
    return table


def _warm_up(plan: CampaignPlan) -> str:
    w = plan.warm_up
    if not w.at_most:
        return "none"
    return f"until {w.window} club speeds lie within {w.tolerance:g} m/s, at most {w.at_most} shots a section"


def _order(plan: CampaignPlan, trials: list[PlannedShot]) -> str:
    """Return a block's order; in a split-plot a line for each mounting."""
    if not plan.split:
        return "  ".join(_word(plan, trial) for trial in trials)
    mountings = [(club, list(group)) for club, group in groupby(trials, key=lambda t: t.arm.club)]
    if len(plan.design.balls) < 2:
        return "  ".join(f"{escape(club)} × {len(group)}" for club, group in mountings)
    lines = (f"{escape(club)}: {'  '.join(escape(t.arm.ball) for t in group)}" for club, group in mountings)
    return "\n".join(lines)


def _word(plan: CampaignPlan, trial: PlannedShot) -> str:
    level = escape(getattr(trial.arm, plan.design.compare))
    return f"[dim]({escape(trial.arm.ball)})[/]" if trial.role is Role.CONTROL else level


def outlook_words(plan: CampaignPlan) -> list[str]:
    """Return the resolution of the plan in words."""
    a, found = plan.analysis, outlook(plan)
    unit = display_unit(a.quantity).unit
    if not found.pairs:
        return ["One level only: it is described, nothing is compared."]
    if not a.expected_sd:
        return ["No standard deviation is stated (analysis.expected_sd): the resolution is unknown."]
    together = f", {found.pairs} pairs together" if found.pairs > 1 else ""
    between = f" and {a.ball_sd:g} {unit} between balls" if a.ball_sd else ""
    if plan.design.compare == "club" and a.mounting_sd:
        between = f" and {a.mounting_sd:g} {unit} between mountings"
    needed = None if found.needed is None else SeriesSize(found.balls or 0, found.needed)
    lines = [
        f"Expected: with a standard deviation of {a.expected_sd:g} {unit} a shot{between}, a difference of "
        f"{_figure(found.resolution)} {unit} is found with a chance of {100 * a.power:.0f} %"
        f" at {100 * a.confidence:g} % confidence{together}.",
        f"A difference of {a.target_difference:g} {unit} is found with a chance of "
        f"{100 * (found.power or 0):.0f} %; "
        f"{series_words(needed, plan)} would make it {100 * a.power:.0f} %.",
    ]
    if a.covariates:
        lines.append(
            f"Corrected by {', '.join(NAMES[name] for name in a.covariates)}, expected to explain "
            f"{100 * a.expected_r_squared:.0f} % of a shot's variance; without it would take "
            f"{found.without or 'too many'} valid shots of each."
        )
    if plan.design.compare == "ball":
        balls = balls_of_each(plan)
        lines.append(
            "One ball of each: results hold for these balls, not for their models."
            if balls == 1
            else f"Each model is judged by its balls: {balls} of each, {plan.design.blocks / balls:.3g} hits "
            f"of each on average; differences: {found.dof:.0f} degrees of freedom."
        )
    if plan.split:
        lines.append(
            f"Split-plot: clubs are judged by their mountings, {plan.design.blocks} of each, with "
            f"{plan.shots_per_mounting} shots; differences have {found.dof:.0f} degrees of freedom."
        )
        if len(plan.design.balls) > 1:
            words = outlook_words(within_club(plan, plan.design.clubs[0]))[0].removeprefix("Expected: ")
            lines.append(f"Balls within {plan.design.clubs[0]}: {words}")
    if found.same is not None:
        lines.append(
            f"If they are truly equal, they are called the same (within {a.equivalence_margin:g} {unit}) "
            f"with a chance of {100 * found.same:.0f} %."
        )
    if (found.power or 0) < a.power:
        lines.append("Not enough shots for this power: plan more blocks or a larger difference.")
    return lines


def series_words(series: SeriesSize | None, plan: CampaignPlan) -> str:
    """Return a size in words."""
    if series is None:
        return "too many valid shots to name"
    if plan.split:
        return f"{series.shots} valid shots of each in {series.balls} mountings of each"
    if not series.balls or series.balls == series.shots:
        return f"{series.shots} valid shots of each" + (", each with another ball" if series.balls else "")
    return f"{series.shots} valid shots of each, with {series.balls} balls of each"


def _figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
