"""Ten thousand campaigns with known truth: coverage, false positives, and power as the plan foretold.

Statistics only: shots are drawn from the model of a campaign, not swung. Cases and seeds are those of
`tests.bench.campaign.known_truth`. Options: `--campaigns N` a case, and those of the engine.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np

from bench.campaign.plan.plan import CampaignPlan, levels
from bench.campaign.plan.shot_sequence import Role, block_trials, sections
from bench.records.shot.shot import Shot, ShotStatus
from tests.bench.campaign.known_truth import Case, Counts, cases, rows_of, tally
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


@dataclass(frozen=True)
class KnownCampaigns:
    """Counts of campaigns of a case, by number."""

    case: Case
    difference: float
    by_shots: bool

    def prepared(self) -> Callable[[int], Counts]:
        """Return the function of a number."""
        return lambda number: tally(self.case, self.difference, 1, number, by_shots=self.by_shots)


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Run all cases; takes some hours of processor time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=CAMPAIGNS, help="a case")
    add_engine_options(parser)
    options = parser.parse_args(arguments)

    def counted(
        case: Case, difference: float, count: int, first: int = 0, *, by_shots: bool = False
    ) -> Counts:
        study = KnownCampaigns(case, difference, by_shots)
        counts = swept(options, study, range(first, first + count), case.name)
        return Counts(*(sum(column) for column in zip(*map(astuple, counts), strict=True)))

    return [row for case in cases() for row in rows_of(case, options.campaigns, 3.0, counted)]
