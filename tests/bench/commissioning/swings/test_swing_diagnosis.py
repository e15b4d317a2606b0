"""Diagnosis, from a recorded swing, of a robot that changed since its measurement."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from bench.base.errors import Refused
from bench.base.lifecycle import Phase
from bench.commissioning.machine.commissioning_step import (
    Arm,
    MachineFault,
    PredictionFails,
    SimulatedSeries,
)
from bench.commissioning.swings._short_predictions import RecordedSwing
from bench.commissioning.swings.speed_ramp import bench_of
from bench.commissioning.swings.swing_diagnosis import DiagnosedRobot, Diagnosis, diagnose
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.records.telemetry.cycle_record import CYCLE
from bench.simulation.safety import RunEnd, SafetyLimits, unsafe_reasons
from bench.simulation.simulated_bench import ArmingFailed, Bench, ReturnFailed
from bench.swing.profile import Profile
from tests.bench.commissioning.wrong_machines import measured_values, swung_wrongly, true_robot
from tests.compiled_only import needs_speed
from tests.sampling import release_except

CASES = swung_wrongly(load_configuration(shipped_configuration()).plant)
pytestmark = [
    needs_speed,
    pytest.mark.timeout(900),
]


def diagnosed(configuration: Configuration, profile: Profile, name: str) -> tuple[Diagnosis, list[str]]:
    """Return the diagnosis of a swing of the case `name`, and why it is unsafe."""
    plant = configuration.plant
    case = swung_wrongly(true_robot(plant, 1))[name]
    series = SimulatedSeries(bench_of(configuration, profile), case.robot, case.faults)
    try:
        made = series.swing(profile)
    except ReturnFailed as error:
        made = error.swing
    said = diagnose(made.cycles, plant, measured_values(plant))
    return said, unsafe_reasons(RunEnd(series.loads()), SafetyLimits())


def test_recorded_swing_true_plant_errors_are_small(configuration: Configuration, default: Profile) -> None:
    plant = configuration.plant
    made = SimulatedSeries(bench_of(configuration, default), plant).swing(default)
    recorded = RecordedSwing(made.cycles, plant)
    assert len(recorded.contacts) == 1
    scatter = np.sqrt(np.mean(np.square(recorded.errors(plant)), axis=0))
    assert scatter[3:6].max() < 0.03, "rad/s"
    assert scatter[6:].max() < 300.0, "Pa"


@pytest.mark.parametrize("name", release_except({"nothing wrong"}, CASES))
def test_diagnose_swing_names_injected_change(
    configuration: Configuration, default: Profile, name: str
) -> None:
    said, unsafe = diagnosed(configuration, default, name)
    assert said.named is None or CASES[name].is_named_by(said), said.text
    assert name != "nothing wrong" or said.named is None
    assert name != "hose of the arm leaks" or said.named is not None
    assert not unsafe


@pytest.mark.release
def test_diagnosed_robot_explained_swing_raises_machine_fault(
    configuration: Configuration, default: Profile, tmp_path: Path
) -> None:
    case, bench = CASES["supply sags"], bench_of(configuration, default)
    watched = DiagnosedRobot(
        lambda bench: SimulatedSeries(bench, case.robot, case.faults),
        measured_values(configuration.plant),
        tmp_path,
    )
    with pytest.raises(MachineFault, match=r"supply: it sags(?s:.)*clogged filter") as found:
        watched.series(bench).swing(default)
    assert (tmp_path / "wrong-swing.npz").exists()
    assert watched.explained(found.value) is found.value, "said already"


def test_diagnosed_robot_series_enables_model_check(
    configuration: Configuration, default: Profile, tmp_path: Path
) -> None:
    armed = list[Bench]()

    DiagnosedRobot(cast("Arm", armed.append), (), tmp_path).series(bench_of(configuration, default))
    parameters = armed[0].series_controller()
    assert parameters.model["check"][0]
    assert np.isfinite(parameters.model["air"][0, Phase.DOWNSWING]).all()


def test_diagnosed_robot_failed_arming_stores_records(
    configuration: Configuration, default: Profile, tmp_path: Path
) -> None:
    def failing(bench: Bench) -> SimulatedSeries:
        error = ArmingFailed("homing", "encoder R1 jumps", "state READY", "Follow the text, then --resume.")
        error.cycles = np.zeros(7, CYCLE)
        raise copy.copy(error)  # as another process hands it over

    watched = DiagnosedRobot(failing, (), tmp_path / "records")
    with pytest.raises(Refused, match=r"encoder R1 jumps; records in .*failed-arming\.npz"):
        watched.series(bench_of(configuration, default))
    assert len(np.load(tmp_path / "records" / "failed-arming.npz")["cycles"]) == 7


def test_diagnosed_robot_unexplained_fault_reports_misfit(tmp_path: Path) -> None:
    watched = DiagnosedRobot(cast("Arm", None), (), tmp_path)
    error = Refused("swing of 60 %", "30 m/s", "26 m/s", "Look.")
    assert watched.explained(error) is error, "nothing has swung"
    watched.last = Diagnosis(None, (), 0.1, np.full(3, 0.02), np.full(3, 100.0), 1.0)
    assert "moves as measured (misfit 0.1" in watched.explained(error).found
    prediction = PredictionFails("prediction of the swing of 60 %", "stopped", "a swing", "Look.")
    assert watched.explained(prediction) is prediction
