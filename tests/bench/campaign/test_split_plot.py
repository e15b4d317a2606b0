"""Clubs that stay mounted: layout, prompts, comparison by mountings; balls within clubs by shots."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from io import StringIO
from itertools import combinations, groupby, pairwise

import numpy as np
import pytest
from rich.console import Console
from scipy import stats

from bench.campaign.plan.bench_setup import Fitting, missing, sample_for
from bench.campaign.plan.gate import Centre
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import PlannedShot, Step, all_trials, sections
from bench.campaign.report.campaign_record import CampaignRecord
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import findings, findings_record
from bench.campaign.report.preview import outlook, outlook_words, show_preview
from bench.campaign.run.plan_requirements import needs, needs_words
from bench.campaign.run.progress import CampaignProgress
from bench.campaign.run.runner_control import new_entry
from bench.campaign.statistics.analysis import analyse
from bench.campaign.statistics.block_model import as_split_plot, fully_randomised
from bench.records.shot.shot import Shot, ShotStatus
from bench.store.rows import CampaignState, PromptKind, Standing
from tests.bench.campaign.known_truth import Known, cases, drawn
from tests.bench.campaign.plans import NOW, SHIPPED, compared, row_of, shipped_plan, with_values

pytestmark = pytest.mark.usefixtures("undrawn")

BALLS = {"tour": 0.0, "range": 7.0}
CLUBS = {"driver": 0.0, "driver-9": 2.0, "driver-12": 5.0}


def _plan(blocks: int = 5, hits: int = 4, balls: tuple[str, ...] = ("tour", "range")) -> CampaignPlan:
    design = {"blocks": blocks, "hits_per_mounting": hits, "balls": balls}
    return shipped_plan("clubs-split-plot", design=design)


def _shots(plan: CampaignPlan, mounting: float, sd: float, seed: int = 1) -> list[Shot]:
    random = np.random.default_rng(seed)
    mounted = mounting * random.normal(size=(len(plan.design.clubs), plan.design.blocks + 1))
    shots = []
    for number, trial in enumerate(all_trials(plan), 1):
        club, ball = trial.arm.club, trial.arm.ball
        carry = 180 + CLUBS[club] + BALLS[ball] + mounted[plan.design.clubs.index(club), trial.block]
        carry += 3 * trial.block + sd * random.normal()
        shot = row_of(trial, number, sample_for(plan, trial, Counter()) or 0, carry_m=float(carry))
        shots.append(replace(shot, carry_side_m=float(random.normal()), club_speed_mps=43.0))
    return shots


def test_all_trials_split_plot_keeps_club_mounted_within_block() -> None:
    plan = _plan()
    (section,) = sections(plan)
    assert len(section.arms) == 6
    trials = all_trials(plan)
    for _, block in groupby(trials, key=lambda t: t.block):
        mountings = [list(group) for _, group in groupby(block, key=lambda t: t.arm.club)]
        assert sorted(group[0].arm.club for group in mountings) == sorted(plan.design.clubs)
        for group in mountings:
            for turn in range(4):
                assert {t.arm.ball for t in group[2 * turn : 2 * turn + 2]} == {"tour", "range"}
    assert needs(plan).club_changes == 14
    assert needs(fully_randomised(plan)).club_changes > 60
    assert len(all_trials(fully_randomised(plan))) == len(trials)
    assert "Fully randomised it would be" in needs_words(plan, 10**12)[-1]


def test_sample_for_clubs_of_one_block_hit_same_balls() -> None:
    plan = _plan()
    hit: dict[tuple[int, str], list[tuple[str, int | None]]] = {}
    for trial in all_trials(plan):
        ball = (trial.arm.ball, sample_for(plan, trial, Counter()))
        hit.setdefault((trial.block, trial.arm.club), []).append(ball)
    for block in range(1, 6):
        same = [Counter(hit[block, club]) for club in plan.design.clubs]
        assert same[0] == same[1] == same[2]
        assert set(same[0].values()) == {1}
    assert len({number for balls in hit.values() for _, number in balls}) == 12


def test_missing_same_club_in_next_block_requires_new_mounting() -> None:
    plan = _plan(blocks=40)
    one, two = next(
        (a, b) for a, b in pairwise(all_trials(plan)) if a.block < b.block and a.arm.club == b.arm.club
    )

    def asked(fitting: Fitting, trial: PlannedShot) -> str:
        wanted = missing(plan, fitting, Step(trial, 1, Centre()), 1, {})
        assert wanted is None or wanted.kind is PromptKind.CLUB
        return "" if wanted is None else wanted.text

    club = one.arm.club
    used = Fitting(club).after(row_of(one, 1))
    assert not asked(Fitting(club), one)
    assert not asked(used, one)
    assert asked(used, two) == f"Take club {club} off and mount it again: each mounting counts for itself."
    assert not asked(used._replace(used_in=0), two)
    assert needs(plan).club_changes == 40 * 3 - 1


@pytest.mark.parametrize("balls", [("tour",), ("tour", "range")])
def test_analyse_split_plot_compares_clubs_by_mounting_means(balls: tuple[str, ...]) -> None:
    plan = _plan(blocks=4, balls=balls)
    shots = _shots(plan, 2.0, 1.0)
    comparison = compared(plan, shots)
    means = np.array(
        [
            [np.mean([s.carry_m for s in shots if s.club == c and s.block == b]) for c in plan.design.clubs]
            for b in range(1, 5)
        ]
    )
    rest = means - means.mean(axis=0) - means.mean(axis=1, keepdims=True) + means.mean()
    error = np.sqrt((rest**2).sum() / 6 * 2 / 4)  # the classical whole-plot error
    for pair, (one, two) in zip(comparison.pairs, combinations(range(3), 2), strict=True):
        assert pair.difference == pytest.approx(means[:, one].mean() - means[:, two].mean())
        assert pair.error == pytest.approx(error)
        assert pair.dof == pytest.approx(6)
        assert pair.balls == 4
        assert not pair.models
    known = stats.studentized_range.isf(0.05, 3, 6) / np.sqrt(2)
    widest = (comparison.pairs[0].high_together - comparison.pairs[0].low_together) / 2 / error
    assert widest == pytest.approx(known, rel=0.02)
    assert comparison.ball_sd == pytest.approx(2.0, rel=0.6)
    half = (comparison.pairs[0].high - comparison.pairs[0].low) / 2
    assert half == pytest.approx(stats.t.isf(0.025, 6) * error, rel=1e-3)


def test_analyse_split_plot_compares_balls_within_mountings() -> None:
    plan = _plan()
    quiet, loud = (analyse(plan, _shots(plan, sd, 1.0), 1, "").within for sd in (0.0, 50.0))
    assert [inner.name for inner in loud] == list(plan.design.clubs)
    for one, two in zip(quiet, loud, strict=True):
        assert one.confirmatory is not None
        assert two.confirmatory is not None
        (pair,), (same,) = one.confirmatory.pairs, two.confirmatory.pairs
        assert pair.models
        assert pair.balls == 12
        assert pair.difference == pytest.approx(-7.0, abs=1.5)
        assert same.difference == pytest.approx(pair.difference)  # what a mounting does falls out
        assert same.error == pytest.approx(pair.error)
        assert pair.verdict == "different"


def test_analyse_split_plot_missing_shots_keep_club_differences() -> None:
    plan = _plan()
    shots = [
        replace(shot, status=ShotStatus.FAILED, reason="no ball on the tee")
        if shot.club == "driver" and shot.ball == "tour" and shot.position % 3
        else shot
        for shot in _shots(plan, 0.0, 0.0)
    ]
    found = {(p.first, p.second): p.difference for p in compared(plan, shots).pairs}
    assert found["driver", "driver-9"] == pytest.approx(-2.0)
    assert found["driver", "driver-12"] == pytest.approx(-5.0)


def test_analyse_split_plot_one_mounting_compares_no_clubs() -> None:
    plan = _plan()
    shots = [shot for shot in _shots(plan, 2.0, 1.0) if shot.block == 1]
    result = analyse(plan, shots, 1, "")
    assert result.confirmatory is None
    assert result.within[0].confirmatory is not None
    (first, *_) = findings(plan, shots).sections[0].verdicts
    assert "at least two mountings" in first.detail


def test_analyse_split_plot_many_mountings_have_separate_scatter() -> None:
    plan = _plan(blocks=12, hits=1, balls=("tour",))
    shots = _shots(plan, 0.0, 1.0)
    wild = [
        replace(s, carry_m=s.carry_m + 20 * (-1) ** s.block) if s.club == "driver" and s.carry_m else s
        for s in shots
    ]
    errors = {(p.first, p.second): p.error for p in compared(plan, wild).pairs}
    assert errors["driver-9", "driver-12"] < 0.2 * errors["driver", "driver-9"]


def test_outlook_split_plot_includes_mounting_scatter() -> None:
    plan = _plan()
    found, without = (outlook(one) for one in (plan, with_values(plan, analysis={"mounting_sd": 0.0})))
    assert found.dof == pytest.approx(8)
    assert found.resolution is not None
    assert without.resolution is not None
    assert found.resolution > 1.3 * without.resolution
    words = " ".join(outlook_words(plan))
    assert "2 m a shot and 1 m between mountings" in words
    assert "clubs are judged by their mountings, 5 of each, with 8 shots" in words
    assert "Balls within driver:" in words
    console = Console(record=True, width=120, file=StringIO())
    show_preview(plan, {}, console)
    assert "driver-12: " in console.export_text()


def test_as_split_plot_suggests_layout_for_randomised_clubs() -> None:
    plan = shipped_plan("clubs")
    layout = as_split_plot(plan)
    assert layout is not None
    assert (layout.design.blocks, layout.design.hits_per_mounting) == (3, 4)
    words = needs_words(plan, 10**12)[-1]
    assert "(design.blocks = 3, hits_per_mounting = 4) it would be 8 club changes, about 24 min" in words
    assert as_split_plot(shipped_plan("two-balls")) is None


def test_progress_counts_mountings() -> None:
    plan = _plan()
    entry = replace(new_entry(plan, SHIPPED, NOW, simulated=False), real_time={"club": "driver"})
    progress = CampaignProgress(entry, plan)
    seconds = 120 * plan.design.seconds_per_shot + 14 * plan.hand_work.club_change
    assert progress.message["seconds_left"] == pytest.approx(seconds)


def test_campaign_report_split_plot_names_mountings() -> None:
    plan = _plan()
    shots = _shots(plan, 1.0, 1.0)
    found = findings(plan, shots)
    assert "5 mountings, by which clubs are judged" in found.sections[0].verdicts[0].detail
    assert [v.headline.split(":")[0] for v in found.sections[0].verdicts[1:]] == [f"With {c}" for c in CLUBS]
    entry, standing = new_entry(plan, SHIPPED, NOW, simulated=True), Standing(CampaignState.FINISHED, "", "")
    record = CampaignRecord(entry, standing, plan, shots, [], Counter())
    page = re.sub(r"\s+", " ", re.sub(r"<[^>]*>", "", render_campaign_report(record, found)))
    for wanted in ("Balls within driver-12", "between mountings of one club", "mountings of a club random"):
        assert wanted in page, wanted
    assert [one["name"] for one in findings_record(found)["sections"][0]["within"]] == list(CLUBS)


def test_analyse_split_plot_zero_mounting_sd_keeps_shot_scatter() -> None:
    case = next(case for case in cases() if "no mounting error" in case.name)
    found = []
    for number in range(20):
        comparison = compared(case.plan, drawn(case._replace(known=Known()), 0.0, number)[0])
        if comparison.ball_sd == 0:
            found.append(comparison.sd / Known().sd)
    assert len(found) > 5
    assert 0.85 < min(found) <= max(found) < 1.25
