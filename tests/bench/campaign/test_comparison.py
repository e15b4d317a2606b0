from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bench.campaign.comparison import Difference, compare, shots_needed, verdict

A = [210.1, 211.4, 209.8, 210.9, 210.2]
B = [207.0, 208.8, 207.9, 207.2, 209.1]


def test_the_interval_is_welchs() -> None:
    (found,) = compare({"A": A, "B": B})
    known = stats.ttest_ind(A, B, equal_var=False).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((known.low, known.high), rel=1e-12)
    assert found.mean == pytest.approx(np.mean(A) - np.mean(B))
    assert found.resolved


def test_intervals_of_several_pairs_are_wider() -> None:
    (alone,) = compare({"A": A, "B": B})
    together = compare({"A": A, "B": B, "C": A, "D": [210.0]})
    assert [(d.first, d.second) for d in together] == [("A", "B"), ("A", "C"), ("B", "C")]
    assert together[0].high - together[0].low > alone.high - alone.low


def test_intervals_cover_the_truth_as_often_as_they_say() -> None:
    random = np.random.default_rng(4)
    hits = 0
    for _ in range(1000):
        (d,) = compare({"A": random.normal(1.0, 1.0, 5), "B": random.normal(0.0, 3.0, 7)})
        hits += d.low <= 1.0 <= d.high
    assert 930 <= hits <= 970


@pytest.mark.parametrize(("deviation", "difference", "normal"), [(1.5, 1, 36), (2.5, 2, 25), (6.0, 3, 63)])
def test_shots_needed_lie_just_above_the_normal_approximation(
    deviation: float, difference: float, normal: int
) -> None:
    assert normal <= shots_needed(deviation, difference) <= normal + 2


def test_that_many_shots_do_resolve_the_difference() -> None:
    shots = shots_needed(2.5, 3.0)
    random = np.random.default_rng(8)
    found = [
        compare({"A": random.normal(3.0, 2.5, shots), "B": random.normal(0.0, 2.5, shots)})[0].resolved
        for _ in range(1000)
    ]
    assert 0.77 <= np.mean(found) <= 0.85


def test_no_difference_needs_no_number() -> None:
    assert shots_needed(0.0, 1.0) == 2
    with pytest.raises(ValueError, match="expected more than 0"):
        shots_needed(1.0, 0.0)


def _difference(mean: float, half: float, shots: int = 5, deviation: float = 1.0) -> Difference:
    return Difference("A", "B", mean, mean - half, mean + half, shots, shots, deviation)


def test_verdicts_say_who_is_ahead() -> None:
    assert verdict(_difference(3, 1), "carry", "yd", 1).headline == "A has 3.0 yd more carry than B."
    found = verdict(_difference(-3, 1), "carry", "yd", 1)
    assert found.headline == "B has 3.0 yd more carry than A."
    assert "A − B: −3.0 yd (95 % confidence interval −4.0 to −2.0 yd" in found.detail


def test_verdicts_say_when_there_are_too_few_shots_and_how_many_it_takes() -> None:
    found = verdict(_difference(0.5, 1), "carry", "yd", 1)
    assert not found.resolved
    assert found.headline.startswith("Not enough shots")
    assert f"about {shots_needed(1.0, 1)} shots a ball" in found.detail


def test_verdicts_say_when_a_difference_would_have_been_seen() -> None:
    found = verdict(_difference(0.1, 0.3, shots=40), "carry", "yd", 1)
    assert found.headline == "No difference between A and B in carry was found."


def test_a_simulation_without_noise_is_called_so() -> None:
    (found,) = compare({"A": [200.0] * 5, "B": [198.0] * 5})
    assert "without scatter" in verdict(found, "carry", "yd", 1).headline
