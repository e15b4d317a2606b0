"""Identification: the parameters of a simulated robot from its swings, and the file they become."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.config import load_configuration, shipped_configuration
from bench.learning.identify import NAMES, Identified, identify, variation_of, write_plant_file
from bench.records.telemetry.cycle_record import CYCLE
from bench.simulation.simulated_bench import Bench, Series
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.compiled import new_record
from tests.compiled_only import needs_speed

SHIPPED = load_configuration(shipped_configuration())
BENCH = Bench(SHIPPED.plant, load_profile(find_profile(SHIPPED.swing.profile)), SHIPPED.control)
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
    series = Series(BENCH, variation_of(truth, BENCH).applied_to(BENCH.model))
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
    robot = variation_of(values, BENCH).applied_to(BENCH.model)
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
    cycles["supply_pressure"] = 0.92 * BENCH.model.supply.pressure
    found = identify(BENCH, [cycles], (NAMES[SUPPLY],))
    assert found.values[SUPPLY] == pytest.approx(0.92, abs=0.01)
    assert found.after < 0.5 * found.before
