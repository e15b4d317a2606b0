"""Recorded swings as identification and learning take them: whole ones, planned alike."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.learning.learn import from_first_tick, read_recorded, require_alike
from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.recorder import write_swing
from bench.records.telemetry.swing_metadata import profile_entry
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from drivers.base.compiled import new_record
from sim.plant import PlantParameters

PROFILE = load_profile(find_profile("default"))
BEFORE = 30
"""Ticks of a record before the swing's first."""


def written(path: Path, profile: Profile) -> Path:
    cycles = new_record(CYCLE, BEFORE + len(profile.angle))
    cycles["tick"] = np.arange(len(cycles))
    cycles["phase"][BEFORE + profile.begins[1] :] = Phase.BACKSWING
    plant = {"encoders": {"latency": 0.0012}}
    write_swing(path, cycles, {"profile": profile_entry(profile), "configuration": {"plant": plant}})
    return path


def test_read_recorded_returns_first_tick_profile_and_calibration(tmp_path: Path) -> None:
    paths = [written(tmp_path / f"{n}.parquet", PROFILE) for n in range(2)]
    first, second = read_recorded(paths)
    assert np.array_equal(first.profile.valve, PROFILE.valve)
    assert first.cycles["tick"][0] == second.cycles["tick"][0] == BEFORE
    assert first.encoders == replace(PlantParameters().encoders, latency=0.0012)
    assert read_recorded([]) == []


def test_read_recorded_other_correction_error_names_file(tmp_path: Path) -> None:
    other = replace(PROFILE, valve=PROFILE.valve + 1e-3)
    paths = [written(tmp_path / "one.parquet", PROFILE), written(tmp_path / "two.parquet", other)]
    with pytest.raises(BenchError, match=r"two\.parquet.*with another correction"):
        read_recorded(paths)


def test_from_first_tick_incomplete_swing_raises_error() -> None:
    with pytest.raises(BenchError, match="no complete swing"):
        from_first_tick(new_record(CYCLE, 100), PROFILE, "record")


def test_require_alike_other_correction_or_profile_raises_error() -> None:
    require_alike(PROFILE, replace(PROFILE, text="the same"), "b")
    other = replace(PROFILE, valve=PROFILE.valve + 1e-3)
    with pytest.raises(BenchError, match="with another correction"):
        require_alike(PROFILE, other, "b")
    with pytest.raises(BenchError, match="a swing of driver-90mph"):
        require_alike(PROFILE, load_profile(find_profile("driver-90mph")), "b")
