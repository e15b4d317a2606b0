"""Chances predicted for a plan from random series, where a closed form exists."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bench.campaign.statistics._unequal_variances import Draws
from bench.campaign.statistics.sample_size import PredictedPrecision

PAIRS, SERIES = 3, 50


def predicted(difference: float) -> PredictedPrecision:
    """Return the prediction for three levels whose simulated differences are all `difference`, of error 1."""
    one: Any = np.ones((SERIES, PAIRS), np.float32)
    draws = Draws(one * difference, one, np.full((SERIES, PAIRS), 30.0))
    return PredictedPrecision(1.0, 30.0, 0.05 / PAIRS, PAIRS, draws, 1.0, 0.0, 10, 10)


@pytest.mark.parametrize(("difference", "chance"), [(0.0, 1.0), (4.0, 0.0)])
def test_same_three_levels_is_share_of_series_within_margin(difference: float, chance: float) -> None:
    assert predicted(difference).same(3.0, 0.05) == chance
