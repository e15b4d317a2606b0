"""Rows without a good blind brake take over what stops the robot from the rows around them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bench.design._blind_brake import _GOOD, _BlindSearch, _Found

FAR = np.array([0.9, -0.9, 0.5, 0.3, 0.1, 0.2])
"""A pattern that stops the robot, behind a ridge from where searches begin."""


def hollow(_: Any, row: int, pattern: np.ndarray[Any, Any]) -> float:
    """Cost with a flat minimum of 2 at centred spools, and one of 0 at FAR."""
    return float(min(2.0 + 0.1 * np.abs(pattern).sum(), 2.0 * np.abs(pattern - FAR).sum() + 0.01 * row))


@pytest.fixture
def search(monkeypatch: pytest.MonkeyPatch) -> _BlindSearch:
    monkeypatch.setattr(_BlindSearch, "cost", hollow)
    return _BlindSearch(plant=None, states=[], ticks=0)  # type: ignore[arg-type]


def test_blind_search_first_stays_in_local_minimum(search: _BlindSearch) -> None:
    assert search.first(1, None).cost == 2.0


def test_blind_search_around_improves_pattern_of_near_row(search: _BlindSearch) -> None:
    stuck, good = _Found(2.0, np.zeros(6)), _Found(1.2, FAR - 0.1)
    found = search.around(0, [stuck, stuck, good])
    assert found.cost < _GOOD
    assert np.abs(found.pattern - FAR).max() < 0.1


def test_blind_search_around_ignores_far_row(search: _BlindSearch) -> None:
    stuck, good = _Found(2.0, np.zeros(6)), _Found(0.1, FAR)
    assert search.around(0, [stuck] * 8 + [good]) is stuck
