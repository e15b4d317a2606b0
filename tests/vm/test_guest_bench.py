"""The swing of a slower loop, as the guest's bench has it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.swing.library import find_profile
from bench.swing.profile import load_profile, save_profile
from tests.vm.guest_bench import slower


def test_slower_profile_keeps_swing(tmp_path: Path) -> None:
    profile = load_profile(find_profile("default"))
    save_profile(tmp_path / "slower.toml", slower(profile, 2))
    again = load_profile(tmp_path / "slower.toml")
    assert again.period == 2 * profile.period
    assert np.array_equal(again.angle, profile.angle[::2])
    for phase, (before, after) in enumerate(zip(profile.begins, again.begins, strict=True)):
        assert abs(after * again.period - before * profile.period) <= 1.001 * profile.period, phase
    assert again.blind_spacing * again.period == profile.blind_spacing * profile.period
