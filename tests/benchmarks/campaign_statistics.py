"""Ten thousand campaigns with known truth: coverage, false positives, and power as the plan foretold.

Statistics only: shots are drawn from the model of a campaign, not swung. Seeds are fixed beforehand: SEED and
the number of the campaign. Options: `--campaigns N` a case, and those of the engine.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import combinations
from math import sqrt
from pathlib import Path

import numpy as np

from bench.campaign.plan.plan import CampaignPlan, levels
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.plan.shot_sequence import Role, block_trials, sections
from bench.campaign.statistics.analysis import analyse
from bench.campaign.statistics.sample_size import predict_precision
from bench.config import load_configuration
from bench.records.shot.shot import Shot, ShotStatus
from tests.benchmarks.row import Row
from tests.benchmarks.swept import add_engine_options, swept

SEED = 20261121
CAMPAIGNS = 10_000
BEGIN = datetime(2026, 1, 1, tzinfo=UTC)
FIRST = 180.0
"""m, carry of the first level."""


@dataclass(frozen=True)
class Truth:
    """True values of a campaign, in metres of carry."""

    sd: float = 2.0
    difference: float = 0.0
    """Between the first level and all others."""
    block: float = 1.5
    """Standard deviation between blocks."""
    drift: float = 0.02
    """A shot."""
    ball: float = 0.0
    """Standard deviation between balls of one model."""


def campaign_shots(plan: CampaignPlan, truth: Truth, seed: int) -> list[Shot]:
    """Return the shots of a campaign by `plan` in its own order, all valid."""
    random = np.random.default_rng((SEED, seed))
    plan = replace(plan, design=replace(plan.design, seed=int(random.integers(2**31))))
    shots: list[Shot] = []
    names = levels(plan)
    own = random.normal(size=(len(names) + 1, plan.ball_handling.samples)) * truth.ball
    hits: dict[str, int] = {}
    for section in sections(plan):
        for number in range(1, plan.design.blocks + 1):
            effect = truth.block * random.normal()
            for trial in block_trials(plan, section, number):
                level = getattr(trial.arm, plan.design.compare)
                control = trial.role is Role.CONTROL
                code = len(names) if control else names.index(level)
                hits[level] = hits.get(level, -1) + 1
                sample = hits[level] % plan.ball_handling.samples
                carry = FIRST + effect + own[code, sample] + truth.drift * len(shots)
                carry += truth.sd * random.normal() - (truth.difference if code else 0.0)
                shots.append(
                    Shot(
                        len(shots) + 1,
                        trial.block,
                        trial.position,
                        trial.arm.club,
                        trial.arm.ball,
                        ShotStatus.VALID,
                        carry_m=float(carry),
                        swing=trial.arm.swing,
                        role=str(trial.role),
                        section=trial.section,
                        sample=sample + 1,
                        time_utc=BEGIN + timedelta(seconds=48 * len(shots)),
                    )
                )
    return shots


@dataclass
class Tally:
    """How often what happened."""

    covered: int = 0
    found: int = 0
    any_found: int = 0
    same: int = 0
    pairs: int = 0
    campaigns: int = 0


@dataclass(frozen=True)
class KnownCampaigns:
    """Campaigns by a plan with a known truth, by seed."""

    plan: CampaignPlan
    truth: Truth

    def prepared(self) -> Callable[[int], Tally]:
        """Return the function of a seed."""
        return self.judged

    def judged(self, seed: int) -> Tally:
        """Return the tally of the campaign of `seed`."""
        names = levels(self.plan)
        true = {pair: self.truth.difference * (pair[0] == names[0]) for pair in combinations(names, 2)}
        result = analyse(self.plan, campaign_shots(self.plan, self.truth, seed), 1, "").confirmatory
        if result is None:
            raise RuntimeError("a complete campaign without an answer")
        verdicts = [pair.verdict in {"different", "both"} for pair in result.pairs]
        null = [
            v for pair, v in zip(result.pairs, verdicts, strict=True) if not true[pair.first, pair.second]
        ]
        return Tally(
            covered=sum(pair.low <= true[pair.first, pair.second] <= pair.high for pair in result.pairs),
            found=int(verdicts[0]),
            any_found=int(any(null)),
            same=int(result.pairs[0].verdict in {"same", "both"}),
            pairs=len(result.pairs),
            campaigns=1,
        )


def plans() -> tuple[CampaignPlan, CampaignPlan]:
    """Return a plan of two balls with a control ball, and one of four without."""
    configuration = load_configuration(Path("shipped"))
    two = load_plan(Path("symmetry"), configuration)
    two = replace(
        two,
        design=replace(two.design, blocks=12),
        stop=replace(two.stop, rule="fixed"),
        analysis=replace(
            two.analysis, expected_sd=2.0, target_difference=2.5, equivalence_margin=2.5, power=0.8
        ),
    )
    ten = load_plan(Path("ten-balls"), configuration)
    four = replace(
        ten,
        design=replace(ten.design, balls=("a", "b", "c", "d"), blocks=10),
        control=replace(ten.control, ball=""),
        analysis=replace(ten.analysis, expected_sd=2.0, target_difference=3.0, equivalence_margin=0.0),
    )
    return two, four


def survey(campaigns: int, options: argparse.Namespace | None = None) -> list[Row]:
    """Return what `campaigns` campaigns a case give; three standard errors, or 5 points for power.

    Without `options` of an engine they run in this process.
    """
    two, four = plans()
    rows: list[Row] = []
    drifting = Truth(drift=0.05)

    def rate(name: str, count: int, of: int, nominal: float, *, errors: int | None = None) -> None:
        half = 3 * sqrt(nominal * (1 - nominal) / (errors or of))
        note = f"of {of}, nominal {nominal:.4f}"
        rows.append(Row("campaign statistics", name, count / of, "", note, nominal - half, nominal + half))

    def foretold(name: str, count: int, of: int, power: float) -> None:
        half = max(0.05, 3 * sqrt(power * (1 - power) / of))
        note = f"of {of}, foretold {power:.4f}"
        rows.append(Row("campaign statistics", name, count / of, "", note, power - half, power + half))

    def tally(plan: CampaignPlan, truth: Truth, first_seed: int) -> Tally:
        seeds = range(first_seed, first_seed + campaigns)
        study = KnownCampaigns(plan, truth)
        tallies = (
            swept(options, study, seeds, f"{len(levels(plan))} balls")
            if options
            else list(map(study.judged, seeds))
        )
        return Tally(*(sum(column) for column in zip(*(astuple(one) for one in tallies), strict=True)))

    null = tally(two, drifting, 0)
    rate("two balls, equal: interval covers the truth", null.covered, null.pairs, 0.95)
    rate("two balls, equal: called different", null.found, null.campaigns, 0.05)
    a = two.analysis
    ahead = predict_precision(two, 2.0, 0.0)
    if ahead is None:
        raise RuntimeError("nothing is foreseen")
    same = ahead.same(a.equivalence_margin, 0.05)
    foretold("two balls, equal: called the same (TOST)", null.same, null.campaigns, same)
    real = tally(two, replace(drifting, difference=a.target_difference), campaigns)
    rate("two balls, different: interval covers the truth", real.covered, real.pairs, 0.95)
    power = ahead.power(a.target_difference)
    foretold("two balls, different: found", real.found, real.campaigns, power)
    rate("two balls, at the margin: called the same", real.same, real.campaigns, 0.05)
    raw = replace(two, analysis=replace(two.analysis, drift="none"))
    plain = tally(raw, Truth(drift=0.0), 2 * campaigns)
    rate("two balls, raw: interval covers the truth", plain.covered, plain.pairs, 0.95)
    many = tally(four, Truth(), 3 * campaigns)
    # Pairs of one campaign share its shots: their errors are counted by campaigns, not by pairs.
    rate("four balls, equal: interval covers the truth", many.covered, many.pairs, 0.95, errors=campaigns)
    error = Row(
        "campaign statistics",
        "four balls, equal: any pair called different",
        many.any_found / many.campaigns,
        "",
        f"of {many.campaigns}, at most 0.05",
        None,
        0.05 + 3 * sqrt(0.05 * 0.95 / campaigns),
    )
    rows.append(error)
    return rows


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Run all cases; takes some minutes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=CAMPAIGNS, help="a case")
    add_engine_options(parser)
    options = parser.parse_args(arguments)
    return survey(options.campaigns, options)
