"""Interim analyses before the end of a plan: significance levels, counting, texts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.report.campaign_record import load_record, note_look
from bench.campaign.report.findings import findings
from bench.campaign.report.verdicts import confidence_words
from bench.campaign.run.runner_control import new_entry
from bench.campaign.statistics.sample_size import look_level, look_now, share_done, spent
from bench.config import database_url
from bench.store.campaigns import CampaignStore, StoredShot
from bench.store.database import open_database
from bench.store.rows import CampaignState
from tests.bench.campaign.plans import NOW, SHIPPED, shipped_plan
from tests.benchmarks.campaign_statistics import Truth, campaign_shots


@pytest.fixture(scope="module")
def plan() -> CampaignPlan:
    return shipped_plan("two-balls", design={"blocks": 20})


def test_look_level_matches_published_obrien_fleming_limits() -> None:
    # Lan and DeMets' O'Brien-Fleming spending, 5 equal looks, two-sided 5 %: limits in z.
    shares = (0.2, 0.4, 0.6, 0.8, 1.0)
    limits = [4.8769, 3.3569, 2.6803, 2.2898, 2.0310]
    found = [stats.norm.isf(look_level(0.05, shares[:n]) / 2) for n in range(1, 6)]
    assert found == pytest.approx(limits, abs=2e-3)


def test_look_level_single_final_look_has_full_error() -> None:
    assert look_level(0.05, (1.0,)) == 0.05
    assert spent(0.05, 1.0) == 0.05
    assert spent(0.05, 0.0) == 0.0


def test_look_level_look_after_each_block_keeps_error_rate() -> None:
    random, shares = np.random.default_rng(2), tuple(np.arange(1, 21) / 20)
    score = np.cumsum(random.normal(size=(20_000, 20)), axis=1) / np.sqrt(np.arange(1, 21))
    limits = [stats.norm.isf(look_level(0.05, shares[:n]) / 2) for n in range(1, 21)]
    assert (np.abs(score) > limits).any(axis=1).mean() == pytest.approx(0.05, abs=0.005)


def test_look_now_unfinished_plan_counts_look_after_each_block(plan: CampaignPlan) -> None:
    shots = campaign_shots(plan, Truth(), 1)
    assert share_done(plan, shots) == 1.0
    assert look_now(plan, shots, None) == pytest.approx((1.0, 1, 0.05))
    early = look_now(plan, shots[:20], None)
    assert early.share == 0.5
    assert early.number == 10
    once = look_now(plan, shots[:20], [20])
    assert once.number == 1
    assert early.alpha < once.alpha < 0.05
    late = look_now(plan, shots, [20, 30])
    assert late.number == 3
    assert 0.03 < late.alpha < 0.05


def test_findings_interim_look_states_true_confidence(plan: CampaignPlan) -> None:
    shots = campaign_shots(plan, Truth(sd=2.0, difference=3.0), 3)[:20]
    found = findings(plan, shots, [20])
    comparison = found.sections[0].analysis.confirmatory
    assert comparison is not None
    assert comparison.confidence == pytest.approx(1 - spent(0.05, 0.5))
    (verdict,) = found.sections[0].verdicts
    assert f"{confidence_words(comparison.confidence)} % interval" in verdict.detail
    assert "Interim analysis no. 1 has 50 % of the plan's shots; the others are excluded" in verdict.detail
    whole = findings(plan, campaign_shots(plan, Truth(), 3)).sections[0].verdicts[0]
    assert "95 % interval" in whole.detail
    assert "look" not in whole.detail.lower()


@pytest.mark.parametrize(
    ("confidence", "words"),
    [(0.95, "95"), (0.983333, "98.3"), (0.99944, "99.944"), (0.9999999999, "> 99.999999"), (0.9, "90")],
)
def test_confidence_words_never_rounds_up(confidence: float, words: str) -> None:
    assert confidence_words(confidence) == words


def test_note_look_unfinished_campaign_stores_event(plan: CampaignPlan, tmp_path: Path) -> None:
    entry = new_entry(plan, SHIPPED, NOW, simulated=True)
    shots = [StoredShot(shot) for shot in campaign_shots(plan, Truth(), 4)]
    with open_database(database_url("", tmp_path)) as engine:
        store = CampaignStore(engine)
        store.begin(entry)
        store.add(entry, shots[:10])
        assert note_look(store, load_record(store, entry), "report") == [10]
        assert note_look(store, load_record(store, entry), "report") == [10]
        store.add(entry, shots[10:20])
        assert note_look(store, load_record(store, entry), "end of a run") == [10, 20]
        (first, second) = (event for event in store.events(entry.id) if event.kind == "look")
        assert first.text == "interim analysis of 10 shots: report"
        assert second.before_shot == 21
        store.add(entry, shots[20:])
        store.change(entry.id, state=CampaignState.FINISHED)
        record = load_record(store, entry)
        assert note_look(store, record, "report") == [10, 20]
    look = findings(plan, record.shots, [10, 20]).sections[0].analysis.look
    assert look.number == 3
    assert look.alpha < 0.05
