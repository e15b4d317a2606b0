"""Identification: recorded swings that it takes, the parameters found, and the file they become."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.config import load_configuration, shipped_configuration
from bench.learning.identify import (
    NAMES,
    Identified,
    from_first_tick,
    identify,
    read_recorded,
    variation_of,
    write_plant_file,
)
from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.record_file import write_swing
from bench.records.telemetry.swing_metadata import profile_entry
from bench.simulation.simulated_bench import Bench, Series
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from drivers.base.compiled import new_record
from tests.compiled_only import needs_speed

SHIPPED = load_configuration(shipped_configuration())
BENCH = Bench(load_profile(find_profile(SHIPPED.swing.profile)), SHIPPED.plant, SHIPPED.control)
FLOW, INERTIA = NAMES.index("flow of the shoulder's valve"), NAMES.index("club inertia")
SUPPLY = NAMES.index("supply pressure")


def nominal() -> np.ndarray:
    values = np.ones(len(NAMES))
    values[-1] = 0.0
    return values


@pytest.mark.release
@needs_speed
def test_identify_two_swings_recovers_flow_and_inertia() -> None:
    truth = nominal()
    truth[FLOW], truth[INERTIA] = 0.92, 1.05
    series = Series(BENCH, variation_of(truth, BENCH).applied_to(BENCH.plant))
    swings = [series.swing(BENCH.profile).cycles for _ in range(2)]
    found = identify(BENCH, swings, (NAMES[FLOW], NAMES[INERTIA]))
    assert found.values == pytest.approx(truth, abs=0.02)
    assert found.after < 0.3 * found.before
    assert list(np.flatnonzero(found.known)) == [FLOW, INERTIA]


def test_write_plant_file_loads_as_identified_configuration(tmp_path: Path) -> None:
    values = nominal() + 0.05
    error = np.full(len(NAMES), 0.01)
    error[0] = 0.2
    found = Identified(values, error, 5.0, 0.5)
    robot = variation_of(values, BENCH).applied_to(BENCH.plant)
    path = tmp_path / "robot.toml"
    write_plant_file(path, robot, found, SHIPPED)
    assert f"{NAMES[0]}: 1.0500 times nominal, 0.2000; NOT identified" in path.read_text()
    again = load_configuration(path)
    assert again.plant == robot
    assert again.control == SHIPPED.control


def test_identify_failed_search_restarts_from_measured_supply(monkeypatch: pytest.MonkeyPatch) -> None:
    """Far from the recorded robot all look alike: from the nominal supply nothing leads there."""

    def errors(bench: Bench, values: np.ndarray, seen: np.ndarray) -> np.ndarray:
        off = abs(values[SUPPLY] - 0.92)
        return np.full(int(np.isfinite(seen).sum()), min(100.0 * off, 3.0))

    monkeypatch.setattr("bench.learning.identify._errors", errors)
    cycles = new_record(CYCLE, len(BENCH.profile.angle))
    cycles["supply_pressure"] = 0.92 * BENCH.plant.supply.pressure
    found = identify(BENCH, [cycles], (NAMES[SUPPLY],))
    assert found.values[SUPPLY] == pytest.approx(0.92, abs=0.01)
    assert found.after < 0.5 * found.before


PROFILE = BENCH.profile
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
