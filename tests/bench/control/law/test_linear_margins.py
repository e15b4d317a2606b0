"""Margins against loops whose margins are known in closed form."""

from __future__ import annotations

from math import atan, pi, sqrt

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.control.law.linear_loop import margins_of

FREQUENCY = np.geomspace(0.01, 1000.0, 20000)
S: NDArray[np.complex128] = np.asarray(1j * FREQUENCY, dtype=complex)


def test_margins_of_three_equal_lags_match_closed_form() -> None:
    margins = margins_of(FREQUENCY, np.asarray(4.0 / (1 + S) ** 3))  # grows at 8
    assert margins.gain == pytest.approx(2.0, rel=1e-4)
    crossover = sqrt(4.0 ** (2 / 3) - 1)
    assert margins.crossover == pytest.approx(crossover, rel=1e-4)
    assert margins.phase == pytest.approx(pi - 3 * atan(crossover), rel=1e-3)
    assert margins.delay == pytest.approx(margins.phase / crossover, rel=1e-3)
    assert margins.lowest_gain == 0.0
    assert 0 < margins.modulus < 1 - 1 / margins.gain + 1e-6


def test_margins_of_conditionally_stable_loop_give_lowest_gain() -> None:
    response = 3.0 * (1 + S) ** 2 / S**3
    margins = margins_of(FREQUENCY, response)
    assert margins.gain == np.inf
    assert margins.lowest_gain == pytest.approx(0.5 / 3.0, rel=1e-3)  # (1 + j)^2 / j^3 = -2 at 1 rad/s


def test_margins_of_loop_without_crossover_are_infinite() -> None:
    margins = margins_of(FREQUENCY, 0.1 / (1 + S))
    assert (margins.gain, margins.phase, margins.delay, margins.crossover) == (np.inf, np.inf, np.inf, 0.0)
    assert margins.modulus > 0.99
