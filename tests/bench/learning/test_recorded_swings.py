"""Recorded swings as identification takes them: whole ones, planned alike."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.learning.identify import from_first_tick, read_recorded
from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.record_file import write_swing
from bench.records.telemetry.swing_metadata import profile_entry
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from drivers.base.compiled import new_record

PROFILE = load_profile(find_profile("default"))
BEFORE = 30
"""Ticks of a record before the swing's first."""


def written(path: Path, profile: Profile) -> Path:
    cycles = new_record(CYCLE, BEFORE + len(profile.angle))
    cycles["tick"] = np.arange(len(cycles))
    cycles["phase"][BEFORE + profile.begins[1] :] = Phase.BACKSWING
    write_swing(path, cycles, {"profile": profile_entry(profile)})
    return path


def test_read_recorded_returns_profile_and_records_from_first_tick(tmp_path: Path) -> None:
    paths = [written(tmp_path / f"{n}.parquet", PROFILE) for n in range(2)]
    profile, (first, second) = read_recorded(paths)
    assert np.array_equal(profile.valve, PROFILE.valve)
    assert first["tick"][0] == second["tick"][0] == BEFORE
    with pytest.raises(BenchError, match="no record"):
        read_recorded([])


def test_read_recorded_other_correction_error_names_file(tmp_path: Path) -> None:
    other = replace(PROFILE, valve=PROFILE.valve + 1e-3)
    paths = [written(tmp_path / "one.parquet", PROFILE), written(tmp_path / "two.parquet", other)]
    with pytest.raises(BenchError, match=r"two\.parquet.*with another correction"):
        read_recorded(paths)


def test_from_first_tick_incomplete_swing_raises_error() -> None:
    with pytest.raises(BenchError, match="no complete swing"):
        from_first_tick(new_record(CYCLE, 100), PROFILE, "record")


def test_read_recorded_other_profile_raises_error(tmp_path: Path) -> None:
    other = load_profile(find_profile("driver-90mph"))
    paths = [written(tmp_path / "one.parquet", PROFILE), written(tmp_path / "two.parquet", other)]
    with pytest.raises(BenchError, match="a swing of driver-90mph"):
        read_recorded(paths)
