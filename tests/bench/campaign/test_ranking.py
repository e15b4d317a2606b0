"""Letters: two levels share one exactly if their difference was not shown."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from bench.campaign.report.findings import compact_letters, ranking
from tests.bench.campaign.plans import compared, shipped_plan
from tests.benchmarks.campaign_statistics import Truth, campaign_shots


@pytest.mark.parametrize("seed", range(40))
def test_compact_letters_only_different_pairs_share_no_letter(seed: int) -> None:
    random = np.random.default_rng(seed)
    names = [f"ball {n}" for n in range(random.integers(2, 11))]
    pairs = list(combinations(names, 2))
    different = {pair for pair in pairs if random.random() < random.uniform(0.1, 0.9)}
    letters = compact_letters(names, different)
    assert all(letters.values())
    for one, two in pairs:
        assert ((one, two) in different) == (not set(letters[one]) & set(letters[two]))


def test_compact_letters_match_textbook() -> None:
    far = [("a", "c"), ("a", "d"), ("b", "d")]
    assert compact_letters(["a", "b", "c", "d"], far) == {"a": "a", "b": "ab", "c": "bc", "d": "c"}
    assert compact_letters(["a", "b"], []) == {"a": "a", "b": "a"}
    assert compact_letters(["a", "b"], [("b", "a")]) == {"a": "a", "b": "b"}


def test_compact_letters_thirty_groups_are_unique() -> None:
    names = [str(n) for n in range(30)]
    letters = compact_letters(names, combinations(names, 2))
    assert len(set(letters.values())) == 30
    assert letters["26"] == "a'"


def test_ranking_orders_by_effect() -> None:
    plan = shipped_plan("ten-balls")
    shots = [s for s in campaign_shots(plan, Truth(sd=1.0, difference=6.0), 1) if s.section == 1]
    comparison = compared(plan, shots)
    found = ranking(comparison)
    assert [one.rank for one in found] == list(range(1, 11))
    assert [one.effect for one in found] == sorted((one.effect for one in found), reverse=True)
    assert sum(one.effect for one in found) == pytest.approx(0, abs=1e-9)
    verdicts = {frozenset((p.first, p.second)): p.verdict for p in comparison.pairs}
    for one, two in combinations(found, 2):
        apart = verdicts[frozenset((one.name, two.name))] in {"different", "both"}
        assert apart == (not set(one.letters) & set(two.letters))
    assert all(one.scatter_letters for one in found)
    assert ranking(None) == ()
