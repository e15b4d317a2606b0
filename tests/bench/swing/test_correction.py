"""Corrections: smooth, at rest outside the downswing, within the valves' range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.swing.correction import Correction, basis_of
from bench.swing.library import find_profile
from bench.swing.profile import load_profile

PROFILE = load_profile(find_profile("default"))


def test_correction_is_smooth_and_zero_in_early_swing() -> None:
    basis = basis_of(PROFILE)
    point = np.random.default_rng(1).uniform(-1, 1, basis.size)
    correction = basis.correction(point)
    begun = PROFILE.begins[2] - round(0.2 / PROFILE.period)
    assert np.abs(correction.angle[begun:]).max() > 0.01
    assert np.abs(correction.valve).max() > 0.05
    assert not correction.angle[:begun].any()
    assert not correction.valve[:begun].any()
    slope = np.diff(correction.angle, axis=0) / PROFILE.period
    mean = (correction.velocity[1:] + correction.velocity[:-1]) / 2
    assert np.allclose(slope, mean, atol=0.01 * np.abs(slope).max())


def test_correction_applied_valve_commands_stay_within_range() -> None:
    n = len(PROFILE.angle)
    zero = np.zeros((n, 3))
    corrected = Correction(zero + 0.1, zero, zero + 5.0).applied_to(PROFILE)
    assert corrected.valve.max() == 1.0
    assert np.allclose(corrected.angle - PROFILE.angle, 0.1)
    assert corrected.delivery == PROFILE.delivery


def test_correction_of_other_profile_is_refused() -> None:
    short = replace(PROFILE, angle=PROFILE.angle[:-5])
    zero = np.zeros_like(PROFILE.angle)
    with pytest.raises(BenchError, match="Learn it again"):
        Correction(zero, zero, zero).applied_to(short)
