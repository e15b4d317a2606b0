"""Verdicts on known truth: false "different", coverage and power of designs as they are really hit.

Shots are drawn, not swung: balls hit again, one ball of each, unequal scatter, missing cells, drift, looks
before the end, three to ten levels, clubs that stay mounted (split-plots). Seeds are fixed: SEED, the row and
the campaign's number.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from math import sqrt
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from bench.campaign.plan.bench_setup import sample_for
from bench.campaign.plan.plan import CampaignPlan, levels
from bench.campaign.plan.shot_sequence import Role, block_trials, looks_after, sections
from bench.campaign.statistics.analysis import Pair, SectionAnalysis, analyse, decide
from bench.campaign.statistics.sample_size import predict_precision
from bench.records.shot.shot import Shot, ShotStatus
from tests.bench.campaign.plans import row_of, shipped_plan, with_values
from tests.benchmarks.row import Row

SEED = 20261122
TITLE = "campaign verdicts"


@dataclass(frozen=True)
class Known:
    """True values of the shots of a row, in metres of carry."""

    sd: float = 2.0
    """SD of one shot, without club speed."""
    scale: tuple[float, ...] = ()
    """Each level's deviation as a multiple; empty: all 1."""
    ball: float = 0.0
    """Between balls of one model."""
    block: float = 1.5
    drift: float = 0.0
    """A shot."""
    mounting: float = 0.0
    """Between mountings of one club."""
    missing: float = 0.0
    """Share of shots without a valid result."""
    speed: float = 0.0
    """Standard deviation of club speed, m/s."""
    per_speed: float = 3.0
    """Carry for each m/s."""


class Case(NamedTuple):
    """A row: a plan and its true values."""

    name: str
    plan: CampaignPlan
    known: Known
    pair: tuple[int, int] | None = None
    """Levels whose interval is evaluated separately, in addition to all."""
    looks: bool = False
    """Looked at after each block."""
    within: bool = False
    """Split-plot: balls within the first club are compared, not clubs."""


def drawn(case: Case, difference: float, number: int) -> tuple[list[Shot], dict[str, float]]:
    """Return a campaign's shots, the first level `difference` above all others, and each level's truth."""
    plan, known = case.plan, case.known
    random = np.random.default_rng((SEED, crc32(case.name.encode()), number))
    plan = with_values(plan, design={"seed": int(random.integers(2**31))})
    names, section = levels(plan), sections(plan)[0]
    trials = [t for b in range(1, plan.design.blocks + 1) for t in block_trials(plan, section, b)]
    count, samples = len(trials), plan.ball_handling.samples
    noise, blocks = random.normal(size=count), known.block * random.normal(size=plan.design.blocks + 1)
    own = known.ball * random.normal(size=(len(names) + len(plan.design.balls), samples))
    speeds = 43.0 + known.speed * random.normal(size=count)
    valid = random.random(count) >= known.missing
    hits, shots = dict.fromkeys(range(len(names) + 1), 0), []
    mounted = known.mounting * random.normal(size=(len(plan.design.clubs), plan.design.blocks + 1))
    for index, trial in enumerate(trials):
        name: str = getattr(trial.arm, plan.design.compare)
        code = len(names) if trial.role is Role.CONTROL else names.index(name)
        sample, item = hits[code] % samples, code
        hits[code] += 1
        if plan.split:
            sample = (sample_for(plan, trial, Counter()) or 1) - 1
            item = len(names) + plan.design.balls.index(trial.arm.ball)
        scale = known.scale[code] if known.scale and code < len(names) else 1.0
        carry = 180.0 + difference * (code == 0) + own[item, sample] + blocks[trial.block]
        carry += known.drift * index + scale * known.sd * noise[index]
        carry += float(mounted[plan.design.clubs.index(trial.arm.club), trial.block])
        carry += known.per_speed * (speeds[index] - 43.0)
        columns: dict[str, Any] = {"carry_m": float(carry), "club_speed_mps": float(speeds[index])}
        if not valid[index]:
            columns |= {"status": ShotStatus.FAILED, "reason": "no ball on the tee"}
        shots.append(row_of(trial, index + 1, sample + 1, plan.design.repeats + 1, **columns))
    single = samples == 1 and not plan.split  # then the truth is that of these balls
    if case.within:
        return shots, dict.fromkeys(plan.design.balls, 0.0)
    truth = {n: difference * (c == 0) + (own[c, 0] if single else 0.0) for c, n in enumerate(names)}
    return shots, truth


@dataclass
class Counts:
    """How often what happened."""

    campaigns: int = 0
    wrong: int = 0
    """Campaigns with a pair called different whose truth is equal."""
    pairs: int = 0
    covered: int = 0
    watched: int = 0
    """Intervals of `Case.pair` that cover the truth."""
    found: int = 0
    """First pair called different."""
    models: int = 0
    """First pair's verdict is of the models."""
    same: int = 0
    """First pair called the same."""


def _looked(case: Case, shots: Sequence[Shot]) -> Iterator[SectionAnalysis]:
    """Return the analyses shown: at the rule's stop, after each block, or at the end."""
    plan, counts = case.plan, len(shots)
    last = {s.block: s.shot for s in shots}
    ends = [last[b] for b in range(1, plan.design.blocks + 1)]
    if case.looks:
        for number, end in enumerate(ends, 1):
            yield analyse(plan, shots[:end], 1, "", ends[:number])
        return
    for number in sorted(looks_after(plan)):
        if decide(plan, shots[: ends[number - 1]]):
            counts = ends[number - 1]
            break
    yield analyse(plan, shots[:counts], 1, "", ())


def tally(case: Case, difference: float, campaigns: int, first: int = 0, *, by_shots: bool = False) -> Counts:
    """Return the counts of `campaigns` campaigns; `by_shots`: as if each shot had its own mounting."""
    found, names = Counts(), levels(case.plan)
    watched = None if case.pair is None else (names[case.pair[0]], names[case.pair[1]])
    for number in range(first, first + campaigns):
        shots, truth = drawn(case, difference, number)
        wrong = right = False
        pairs: tuple[Pair, ...] = ()
        judged = case
        if by_shots:
            judged = case._replace(plan=with_values(case.plan, design={"hits_per_mounting": 0}))
        for looked in _looked(judged, shots):
            analysis = looked.within[0] if case.within else looked
            pairs = analysis.confirmatory.pairs if analysis.confirmatory else ()
            called = [p for p in pairs if p.verdict in {"different", "both"}]
            wrong |= any(abs(truth[p.first] - truth[p.second]) < 1e-12 for p in called)
            right |= any((p.first, p.second) == (names[0], names[1]) for p in called)
        found.campaigns += 1
        found.wrong += wrong
        found.found += right
        for pair in pairs:
            true = truth[pair.first] - truth[pair.second]
            covered = pair.low <= true <= pair.high
            found.pairs += 1
            found.covered += covered
            found.watched += covered and (pair.first, pair.second) == watched
            if (pair.first, pair.second) == (names[0], names[1]):
                found.models += pair.models
                found.same += pair.verdict in {"same", "both"}
    return found


@cache
def cases() -> list[Case]:
    """Return all rows."""
    symmetry, ten = shipped_plan("symmetry"), shipped_plan("ten-balls", design={"swings": ("default",)})

    def plan(count: int, blocks: int, balls: int, control: bool = False, **analysis: Any) -> CampaignPlan:
        names = tuple("abcdefghij"[:count])
        return with_values(
            ten,
            design={"balls": names, "blocks": blocks},
            control={"ball": "tour" if control else ""},
            ball_handling={"samples": balls},
            analysis={"equivalence_margin": 0.0, "expected_sd": 2.0, **analysis},
        )

    uneven = Known(scale=(3.0, 1.0), missing=0.15, ball=1.0)
    driven = Known(sd=2 * sqrt(0.2), speed=2 * sqrt(0.8) / 3)
    holes, some = Known(ball=1.0, drift=0.05, missing=0.1), Known(ball=1.0, drift=0.02, missing=0.05)
    half, whole, big = Known(ball=1.0), Known(ball=2.0), (4.0, 4.0) + (1.0,) * 8
    speed: dict[str, Any] = {"covariates": ("club_speed_mps",), "expected_r_squared": 0.8}
    return [
        Case("2 levels, 12 balls x 8 hits, ball SD half the shot's", plan(2, 96, 12), half),
        Case("2 levels, 12 balls x 8 hits, ball SD as the shot's", plan(2, 96, 12), whole),
        Case("2 levels, one ball of each x 20", plan(2, 20, 1), Known()),
        Case("2 levels, one ball of each x 20, balls differ", plan(2, 20, 1), whole),
        Case("symmetry as shipped, ball SD half the shot's", symmetry, half),
        Case("symmetry as shipped, ball SD as the shot's", symmetry, whole),
        Case("2 levels, 5 blocks", plan(2, 5, 12), Known()),
        Case("2 levels, control ball, drift", plan(2, 16, 12, control=True), Known(ball=1.0, drift=0.05)),
        Case("2 levels, margin", plan(2, 12, 20, control=True, equivalence_margin=2.5), Known(drift=0.05)),
        Case("2 levels, one 3 times as scattered, cells missing", plan(2, 24, 12), uneven),
        Case("2 levels, looked at after each of 20 blocks", plan(2, 20, 20), Known(), looks=True),
        Case("2 levels, club speed as covariate", plan(2, 12, 12, **speed), driven),
        Case("3 levels, control ball, drift, cells missing", plan(3, 16, 12, control=True), holes),
        Case("3 levels, 4 blocks", plan(3, 4, 12), Known()),
        Case("5 levels, 5 blocks, one 3 times as scattered", plan(5, 5, 12), Known(scale=(3.0, 1, 1, 1, 1))),
        Case("5 levels, 5 blocks", plan(5, 5, 12), Known()),
        Case("4 levels, 10 blocks", plan(4, 10, 12), Known()),
        Case("5 levels, balls hit twice, ball SD as the shot's", plan(5, 24, 12), whole),
        Case("10 levels, two 4 times as scattered", plan(10, 20, 20), Known(scale=big), pair=(0, 1)),
        Case("10 levels, 12 balls, ball SD half the shot's", plan(10, 20, 12), half),
        Case("10 levels as shipped, drift, cells missing", plan(10, 20, 12, control=True), some),
        *_split_cases(),
    ]


def _split_cases() -> list[Case]:
    """Return rows of clubs that stay mounted, balls within them, and the same judged by shots."""

    def plan(count: int, blocks: int, hits: int, balls: int = 1) -> CampaignPlan:
        names, hit = tuple("ABCDE"[:count]), tuple("abc"[:balls])
        design = {"clubs": names, "balls": hit, "blocks": blocks, "hits_per_mounting": hits}
        analysis = {"equivalence_margin": 0.0, "expected_sd": 2.0}
        return shipped_plan("clubs-split-plot", design=design, analysis=analysis)

    half, whole = Known(ball=1.0, mounting=1.0), Known(ball=1.0, mounting=2.0)
    holes = Known(ball=1.0, mounting=2.0, drift=0.02, missing=0.1)
    return [
        Case("split-plot, 2 clubs, 6 mountings x 6 hits, mounting SD half the shot's", plan(2, 6, 6), half),
        Case("split-plot, 2 clubs, 6 mountings x 6 hits, mounting SD as the shot's", plan(2, 6, 6), whole),
        Case("split-plot, 3 clubs, 2 mountings x 6 hits", plan(3, 2, 6), whole),
        Case("split-plot, 3 clubs, 4 mountings x 4 hits", plan(3, 4, 4), whole),
        Case("split-plot, 5 clubs, 4 mountings x 4 hits, no mounting error", plan(5, 4, 4), Known(ball=1.0)),
        Case("split-plot, 3 clubs, 4 mountings, 2 balls x 3 hits, cells missing", plan(3, 4, 3, 2), holes),
        Case("split-plot, 3 balls within a club, 4 mountings x 4 hits", plan(2, 4, 4, 3), whole, within=True),
    ]


def rows_of(case: Case, campaigns: int, slack: float, tally: Callable[..., Counts] = tally) -> list[Row]:
    """Return a row's figures; `slack` binomial standard errors are allowed beyond the promise."""
    plan, known = case.plan, case.known

    several = len(levels(plan)) > 2

    def row(what: str, count: int, of: int, promise: tuple[float, float], independent: int = 0) -> Row:
        rate, low, high = count / max(of, 1), *promise
        middle = (low + high) / 2
        error = sqrt(middle * (1 - middle) / max(independent or of, 1))
        note = f"of {of}, binomial error {error:.4f}, promised {low:.3f} to {high:.3f}"
        return Row(TITLE, f"{case.name}: {what}", rate, "", note, low - slack * error, high + slack * error)

    null = tally(case, 0.0, campaigns)
    rows = []
    fixed = not looks_after(plan)
    if plan.split and known.mounting and not case.within:
        naive = tally(case, 0.0, campaigns, by_shots=True)
        rate, of = naive.wrong / naive.campaigns, naive.campaigns
        rows.append(
            Row(
                TITLE,
                f'{case.name}: as if by shots, false "different"',
                rate,
                "",
                f"of {of}: why clubs are judged by their mountings",
                at_least=0.1 - slack * sqrt(0.09 / of),
            )
        )
    if not (plan.ball_handling.samples == 1 and known.ball):  # else no two balls are equal
        promise = (0.04, 0.06) if fixed and not case.looks else (0.0, 0.06)
        what = 'false "different"' + (", any pair" if several else "")
        rows.append(row(what, null.wrong, null.campaigns, promise))
    if fixed and not case.looks:  # intervals at a stop are those of that look
        rows.append(row("interval covers", null.covered, null.pairs, (0.94, 0.96), null.campaigns))
    if case.pair:
        rows.append(row("interval of the scattered pair covers", null.watched, null.campaigns, (0.94, 0.96)))
    if plan.ball_handling.samples == 1:
        rows.append(row("said of the models", null.models, null.campaigns, (0.0, 0.0)))
    elif fixed and not known.scale and not known.missing and not case.looks and not case.within:
        ahead = predict_precision(plan, known.sd, known.mounting if plan.split else known.ball)
        if ahead is None:
            raise RuntimeError("nothing is foreseen")
        difference = ahead.resolution(0.8)
        real = tally(case, difference, campaigns, campaigns)
        note = row(f"{difference:.2f} m found", real.found, real.campaigns, (0.77, 0.83))
        rows.append(note._replace(note=f"{note.note}, foretold 0.800"))
        if margin := plan.analysis.equivalence_margin:
            same = ahead.same(margin, 0.05)
            rows.append(row("called the same", null.same, null.campaigns, (same - 0.05, same + 0.05)))
            real = tally(case, margin, campaigns, 2 * campaigns)
            rows.append(row("called the same at the margin", real.same, real.campaigns, (0.04, 0.06)))
    return rows
