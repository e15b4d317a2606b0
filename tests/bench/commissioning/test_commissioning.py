"""Commissioning: state, resuming, wrong machines, and the errors of a drawn robot's values."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.base.errors import BenchError, Refused
from bench.calibration.archive import calibration_of
from bench.calibration.calibration import (
    CalibrationKind,
    EncoderZeros,
    SeenInputs,
    ValveCentres,
    wiring_digest,
)
from bench.commands.cli import main
from bench.commands.machine.commission import inputs_in_force, keep_inputs
from bench.commissioning.commissioning import (
    ALL_STEPS,
    STATE_FILE,
    STEPS,
    Commissioning,
    DoneStep,
    begin,
    commission,
    commissioning_process,
    commissioning_report,
    folder_lock,
    read_state,
    robot_file,
)
from bench.commissioning.machine.commissioning_step import (
    MachineFault,
    ParameterEstimate,
    RobotEstimate,
    StepResult,
    Traces,
)
from bench.commissioning.machine.driver_machine import SimulatedMachine, Stalled
from bench.commissioning.machine.inputs import turned_once
from bench.commissioning.machine.machine import CommissionedMachine, MotionBounds, Segment
from bench.commissioning.steps.wiring import WIRING
from bench.commissioning.swings.speed_ramp import bench_of
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.config.files import configuration_text
from bench.control.measured_plant import value_at, with_values
from bench.control.residual_thresholds import load_limits
from bench.design.threshold_generation import DRAWS
from bench.learning.delivery import figures_of
from bench.simulation.simulated_bench import Series
from bench.swing.profile import load_profile
from sim.plant import PlantParameters
from tests.bench.commissioning.drawn_robots import drawn_robot, drawn_robot_file, gap_of
from tests.bench.commissioning.wrong_machines import wrong_machines
from tests.sampling import release_except

DAY = datetime(2026, 5, 1, 12, 0, tzinfo=UTC)
BOUNDS = MotionBounds((10.0, 10.0, 20.0), (6.0, 2.0, 3.0), 5e5)


class _Found:
    """A step that moves nothing and finds the supply."""

    title, bounds_text = "Nothing", "nothing moves"

    def __init__(self, name: str, failing: bool = False, stalls: int = 0) -> None:
        self.name, self.failing, self.stalls, self.runs = name, failing, stalls, 0

    def measure(self, machine: object, known: RobotEstimate) -> Traces:
        self.runs += 1
        if self.runs <= self.stalls:
            raise Stalled("commission", f"stall {self.runs}", "a machine that reads and may move", "End it.")
        return {}

    def estimate(self, traces: Traces, known: RobotEstimate) -> StepResult:
        if self.failing:
            raise MachineFault("supply", "3 bar", "6 bar", "Check it.")
        return StepResult(
            (ParameterEstimate("supply.pressure", 7e5, 100.0, "Pa absolute", self.name),), ("done",)
        )


def exit_code(arguments: list[str]) -> object:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    return ended.value.code


def _run(state: Commissioning, configuration: Configuration) -> RobotEstimate:
    with SimulatedMachine(configuration.plant, configuration.plant) as machine:
        return commission(state, configuration.plant, machine)


def test_with_values_sets_values_by_key() -> None:
    plant = PlantParameters()
    changed = with_values(plant, {"wrist.valve.centre": 0.01, "encoders.sign.1": -1.0})
    assert changed.wrist.valve.centre == 0.01
    assert changed.encoders.sign == (1, -1, 1)
    assert isinstance(changed.encoders.sign[1], int)
    assert value_at(changed, "encoders.sign.1") == -1
    with pytest.raises(KeyError):
        with_values(plant, {"wrist.valve.center": 0.0})


def test_commissioning_state_is_saved_after_each_step_and_repeated_after_fault(
    tmp_path: Path, configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = _Found("first"), _Found("second", failing=True)
    monkeypatch.setattr("bench.commissioning.commissioning.STEPS", (first, second))
    state = begin(tmp_path, configuration, simulated=True)
    with pytest.raises(MachineFault):
        _run(state, configuration)
    stored = read_state(tmp_path)
    assert [step.name for step in stored.done] == ["first"]
    assert stored.wrong is not None
    assert stored.wrong.action == "Check it."
    assert "Check it." in commissioning_report(stored, configuration.plant, DAY)

    with pytest.raises(BenchError, match="--resume"):
        begin(tmp_path, configuration, simulated=True)
    second.failing = False
    state = begin(tmp_path, configuration, simulated=True, repaired="nothing")
    known = _run(state, configuration)
    assert (first.runs, second.runs) == (2, 2)
    assert known.plant.supply.pressure == 7e5
    assert read_state(tmp_path).wrong is None


def test_commission_without_permit_measures_no_step(
    tmp_path: Path, configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = _Found("first"), _Found("second")
    monkeypatch.setattr("bench.commissioning.commissioning.STEPS", (first, second))
    state, runs = begin(tmp_path, configuration, simulated=True), list[int]()

    def refuse() -> None:
        raise Refused("commission", "no press", "a press", "Press the button.")

    with SimulatedMachine(configuration.plant, configuration.plant) as machine:
        with pytest.raises(Refused):
            commission(state, configuration.plant, machine, permit=refuse)
        assert first.runs == 0
        for _ in range(2):
            commission(state, configuration.plant, machine, permit=lambda: runs.append(first.runs))
    assert runs == [0, 1], "once before each step; nothing is left to move later"


def _interrupt() -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("failing", "permit", "error"),
    [(True, tuple, MachineFault), (False, _interrupt, KeyboardInterrupt)],
    ids=["machine fault", "interrupt"],
)
def test_commission_error_turns_regulator_down(
    tmp_path: Path,
    configuration: Configuration,
    monkeypatch: pytest.MonkeyPatch,
    failing: bool,
    permit: Callable[[], object],
    error: type[BaseException],
) -> None:
    step, turned = _Found("first", failing), list[float]()
    monkeypatch.setattr("bench.commissioning.commissioning.STEPS", (step,))
    state, plant = begin(tmp_path, configuration, simulated=True), configuration.plant
    with SimulatedMachine(plant, plant) as machine:
        monkeypatch.setattr(machine, "set_supply", turned.append)
        with pytest.raises(error):
            commission(state, plant, machine, permit=permit)
        assert turned == [plant.supply.atmosphere]
        step.failing = False
        commission(state, plant, machine)
    assert turned[1:] == [inf], "in service afterwards"


@pytest.mark.slow
def test_commission_wired_local_reset_is_requested_before_first_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, asked = _Found("first"), list[int]()
    monkeypatch.setattr("bench.commissioning.commissioning.STEPS", (first,))
    monkeypatch.setattr("bench.commissioning.commissioning.SWINGING_STEPS", ())
    monkeypatch.setattr(
        "bench.commissioning.machine.inputs.await_local_reset", lambda *_: asked.append(first.runs)
    )
    assert exit_code(["commission", "--sim", "--output", str(tmp_path / "day")]) == 0
    assert asked == [0]


def test_commission_stalled_step_is_repeated_at_most_nine_times(
    tmp_path: Path, configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    late, stuck = _Found("late", stalls=3), _Found("stuck", stalls=20)
    monkeypatch.setattr("bench.commissioning.commissioning.STEPS", (late, stuck))
    state = begin(tmp_path, configuration, simulated=True)
    with pytest.raises(Stalled, match="stall 10; it was repeated 9 times"):
        _run(state, configuration)
    (done,) = read_state(tmp_path).done
    assert done.notes == ("done", "repeated: stall 1", "repeated: stall 2", "repeated: stall 3")
    assert (late.runs, stuck.runs) == (4, 10)


def test_commissioning_resume_after_stall_keeps_measured_steps(
    tmp_path: Path, configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = _Found("first"), _Found("second", stalls=10)
    monkeypatch.setattr("bench.commissioning.commissioning.STEPS", (first, second))
    with pytest.raises(Stalled):
        _run(begin(tmp_path, configuration, simulated=True), configuration)
    _run(begin(tmp_path, configuration, simulated=True, repaired="nothing"), configuration)
    assert (first.runs, second.runs) == (1, 11)


def test_commissioning_resume_after_repair_repeats_and_reports(
    tmp_path: Path, configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = _Found("first"), _Found("second", stalls=10)
    monkeypatch.setattr("bench.commissioning.commissioning.STEPS", (first, second))
    with pytest.raises(Stalled):
        _run(begin(tmp_path, configuration, simulated=True), configuration)
    saved = read_state(tmp_path).saved
    other = replace(configuration, plant=replace(configuration.plant, wrist_lever=0.05))
    state = begin(tmp_path, other, simulated=True, repaired="a <new> hose")
    assert state.done == []
    _run(state, other)
    assert first.runs == 2
    stored = read_state(tmp_path)
    (resumed,) = stored.resumed
    assert (resumed.repaired, resumed.interrupted) == ("a <new> hose", saved)
    assert "repaired: a &lt;new&gt; hose" in commissioning_report(stored, other.plant, DAY)


def test_inputs_in_force_check_before_interruption_is_due(
    tmp_path: Path, configuration: Configuration
) -> None:
    c = replace(
        configuration,
        driver=replace(configuration.driver, name="mock"),
        bench=replace(configuration.bench, data_dir=tmp_path),
    )
    entry = keep_inputs(c, SeenInputs(("emergency stop",), wiring_digest(c), (), 0.0), "Ann")
    later = entry.date + timedelta(seconds=1)
    assert inputs_in_force(c, later, "") == entry.name
    assert inputs_in_force(c, later, (entry.date - timedelta(seconds=1)).isoformat()) == entry.name
    assert inputs_in_force(c, later, later.isoformat()) == ""


def test_commission_resume_at_terminal_prompts_for_repairs(
    tmp_path: Path, configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = ["commission", "--sim", "--check", "--resume", "--output", str(tmp_path)]
    begin(tmp_path, configuration, simulated=True).save()
    answers = ["", "Nothing"]
    monkeypatch.setattr("bench.commands.machine.commission.at_terminal", lambda: True)
    monkeypatch.setattr("typer.prompt", lambda text, **_: answers.pop(0))
    assert exit_code(given) == 0
    assert not answers


def test_commissioning_resume_repeats_steps_from_missing_file(
    tmp_path: Path, configuration: Configuration
) -> None:
    state = begin(tmp_path, configuration, simulated=True)
    state.done = [DoneStep(step.name, step.title, "", DAY.isoformat(), 1.0, "", (), ()) for step in ALL_STEPS]
    state.save()
    (tmp_path / "swing.toml").touch()
    done = begin(tmp_path, configuration, simulated=True, repaired="nothing").done
    assert [step.name for step in done] == [step.name for step in ALL_STEPS[:-2]]
    (tmp_path / "learned.toml").touch()
    assert begin(tmp_path, configuration, simulated=True, repaired="nothing").done == state.done


def test_commissioning_resume_other_robot_is_refused(tmp_path: Path, configuration: Configuration) -> None:
    begin(tmp_path, configuration, simulated=True).save()
    plant = replace(configuration.plant, wrist_lever=0.05)
    with pytest.raises(BenchError, match="another configured robot"):
        begin(tmp_path, replace(configuration, plant=plant), simulated=True, repaired="nothing")
    with pytest.raises(BenchError, match="Begin without --resume"):
        begin(tmp_path / "empty", configuration, simulated=True, repaired="nothing")


def test_commissioning_resume_other_wiring_after_measurement_is_refused(
    tmp_path: Path, configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = replace(configuration, bench=replace(configuration.bench, id="other"))
    begin(tmp_path, configuration, simulated=False).save()
    other = replace(other, files=(tmp_path / "other.toml",))
    begin(tmp_path, other, simulated=False, repaired="nothing").save()  # nothing is measured yet
    assert read_state(tmp_path).configuration == str(tmp_path / "other.toml")
    monkeypatch.setattr("bench.commissioning.commissioning.STEPS", (_Found("first"),))
    _run(begin(tmp_path, other, simulated=False, repaired="nothing"), configuration)
    with pytest.raises(BenchError, match="another configured robot"):
        begin(tmp_path, configuration, simulated=False, repaired="nothing")
    begin(tmp_path, other, simulated=False, repaired="nothing")


def test_folder_lock_second_lock_is_refused(tmp_path: Path) -> None:
    assert commissioning_process(tmp_path / "day") is None
    with folder_lock(tmp_path / "day"):
        assert commissioning_process(tmp_path / "day") == os.getpid()
        with pytest.raises(Refused, match=f"process {os.getpid()}"), folder_lock(tmp_path / "day"):
            pass
    assert commissioning_process(tmp_path / "day") is None


def test_commission_check_lists_steps_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "day"
    given = ["commission", "--sim", "--check", "--output", str(folder)]
    assert exit_code([*given, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [(step["name"], step["done"]) for step in said["steps"]] == [
        (step.name, False) for step in ALL_STEPS
    ]
    assert (said["robot"], said["simulated"]) == ("", True)
    exit_code(given)
    assert f"1. {STEPS[0].title} (left)" in capsys.readouterr().out
    assert not folder.exists()


def test_commissioning_state_stores_robot_and_is_refused_without(
    tmp_path: Path, configuration: Configuration
) -> None:
    state = begin(tmp_path / "day", configuration, simulated=True)
    assert not (tmp_path / "day").exists()
    state.robot = "/srv/other.toml"
    state.save()
    assert read_state(tmp_path / "day").robot == "/srv/other.toml"
    file = tmp_path / "day" / STATE_FILE
    content = json.loads(file.read_text())
    del content["robot"]
    file.write_text(json.dumps(content))
    with pytest.raises(BenchError, match="Begin again in another folder"):
        read_state(tmp_path / "day")


@pytest.mark.parametrize(
    ("place", "value", "location"),
    [
        (("done", 0, "values", 0, "key"), "supply.colour", "done[0].values[0].key"),
        (("done", 0, "values", 0, "value"), "high", "done[0].values[0].value"),
        (("done", 0, "seconds"), None, "done[0].seconds"),
        (("simulated",), "yes", "simulated"),
        (("version",), 0, "version"),
        (("wrong",), {"step": "first"}, "wrong"),
        (("done",), "all", "done"),
    ],
)
def test_commissioning_state_invalid_value_is_refused_with_location(
    tmp_path: Path, configuration: Configuration, place: tuple[Any, ...], value: Any, location: str
) -> None:
    state = begin(tmp_path, configuration, simulated=True)
    found = ParameterEstimate("supply.pressure", 7e5, 100.0, "Pa absolute", "first")
    state.done = [DoneStep("first", "First", "", DAY.isoformat(), 1.0, "", (found,), ())]
    state.save()
    content = at = json.loads((tmp_path / STATE_FILE).read_text())
    for part in place[:-1]:
        at = at[part]
    at[place[-1]] = value
    (tmp_path / STATE_FILE).write_text(json.dumps(content))
    with pytest.raises(BenchError, match="Begin again in another folder") as error:
        read_state(tmp_path)
    assert f"{tmp_path / STATE_FILE}: state.{location}" in error.value.location


def test_robot_file_loads_as_configuration(tmp_path: Path, configuration: Configuration) -> None:
    known = RobotEstimate(configuration.plant)
    known.add(
        [
            ParameterEstimate("wrist.valve.centre", 0.0123, 1e-4, "", "valves"),
            ParameterEstimate("encoders.sign.2", -1.0, 0.0, "", "wiring"),
            ParameterEstimate(
                "shoulder.valve.natural_frequency", 500.0, np.float64(5.0), "rad/s", "response"
            ),
        ]
    )
    path = tmp_path / "robot.toml"
    following = configuration.envelope.max_following_error | {"top": (0.25, np.float64(0.2), 0.3)}
    base = str(shipped_configuration().resolve())
    learned = tmp_path / "learned.toml"
    path.write_text(robot_file(known, base, DAY, configuration.envelope, following, learned))
    loaded = load_configuration(path)
    assert loaded.swing.profile == str(learned.resolve())
    assert loaded.plant == known.plant
    assert loaded.commissioned == DAY
    assert loaded.envelope.max_following_error == following
    assert "0.0123  # ± 0.0001; valves" in path.read_text()
    assert "Not measured" in path.read_text()
    model = loaded.envelope.model
    assert model.check == "always"
    assert model.standard_errors == {"wrist.valve.centre": 1e-4, "shoulder.valve.natural_frequency": 5.0}
    path.write_text(configuration_text(loaded))
    assert load_configuration(path).envelope.model == model


def test_robot_file_commands_calibrate_encoders_and_valves(
    tmp_path: Path, configuration: Configuration
) -> None:
    known = RobotEstimate(configuration.plant)
    zeros = {f"encoders.zero_count.{i}": 1234.5 + i for i in range(3)}
    known.add([ParameterEstimate(key, zero, 18.2, "counts", "wiring") for key, zero in zeros.items()])
    known.add([ParameterEstimate("encoders.sign.2", -1.0, 0.0, "", "wiring")])
    known.add([ParameterEstimate("shoulder.valve.centre", -0.01234, 0.0004, "", "valves")])
    base, path = tmp_path / "bench.toml", tmp_path / "first day" / "robot.toml"
    path.parent.mkdir()
    base.write_text(f'base = "shipped"\n[bench]\nid = "robot-{os.getpid()}"\ndata_dir = "{tmp_path}"\n')
    path.write_text(robot_file(known, str(base), DAY, file=path))
    commands = re.findall(r"^# golfbench (.*)$", path.read_text(), re.MULTILINE)
    for command in commands:
        assert f"--config '{path}'" in command
        assert exit_code(shlex.split(command)) == 0
    found = calibration_of(load_configuration(path), datetime.now(UTC))
    encoders, valves = (found.of(kind) for kind in (CalibrationKind.ENCODERS, CalibrationKind.VALVES))
    assert encoders is not None
    assert isinstance(encoders.values, EncoderZeros)
    assert encoders.values.zero_count == tuple(zeros.values())
    assert encoders.values.sign == (1, 1, -1)
    assert valves is not None
    assert valves.values == ValveCentres((-0.01234, 0.0, 0.0), (0.02, 0.02, 0.02), 0.0004)
    assert commands[0].endswith("--uncertainty-deg 0.05")


def test_simulated_machine_exceeded_bound_makes_passive() -> None:
    plant = PlantParameters()
    with SimulatedMachine(plant, plant) as machine:
        machine.vent(1.0)
        trace = machine.run((Segment(3.0, (0.3, 0.0, 0.0)),), BOUNDS._replace(speed=(0.2, 10.0, 20.0)))
        assert trace.tripped is not None
        assert trace.tripped.text.startswith("speed of the shoulder")
        assert not machine.driver.applied.supply_enable


@pytest.mark.parametrize("signal", ["emergency_stop_clear", "guard_closed"])
def test_simulated_machine_open_interlock_ends_run(signal: str) -> None:
    plant = PlantParameters()
    with SimulatedMachine(plant, plant) as machine:
        machine.driver.plant_state[signal] = False
        with pytest.raises(Refused, match="--resume"):
            machine.run((Segment(0.1, (0.1, 0.0, 0.0)),), BOUNDS)
        assert not machine.driver.applied.supply_enable


def test_simulated_machine_without_chamber_sensors_is_refused() -> None:
    plant = replace(PlantParameters(), pressure_sensors=False)
    with pytest.raises(Refused, match="no pressure of shoulder vane A"):
        SimulatedMachine(plant, plant)


QUICKLY_FOUND = ("valves swapped", "vents stay shut", "encoders swapped")
"""Wrong machines that the first minute of the first step finds; the benchmark tries all."""


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", release_except({"valves swapped"}, QUICKLY_FOUND))
def test_wiring_step_wrong_machine_raises_fault(name: str) -> None:
    nominal = PlantParameters()
    case = wrong_machines(drawn_robot(4))[name]
    with SimulatedMachine(case.robot, nominal, case.faults) as machine:
        known = RobotEstimate(nominal)

        def take() -> None:
            WIRING.estimate(WIRING.measure(machine, known), known)

        with pytest.raises(MachineFault) as error:
            take()
        assert case.location in error.value.location
        assert case.words in str(error.value)
        assert machine.loads.stop_share < 1.0


@pytest.mark.release
@pytest.mark.timeout(900)
def test_commission_drawn_robot_errors_cover_true_values(
    tmp_path: Path, configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth, turns = drawn_robot(3, configuration.plant), list[float]()
    state = begin(tmp_path, configuration, simulated=True)
    with SimulatedMachine(truth, configuration.plant) as machine:
        turn = machine.set_supply

        def counted(pressure: float) -> None:
            turns.append(pressure)
            turn(pressure)

        monkeypatch.setattr(machine, "set_supply", turned_once(counted))
        known = commission(state, configuration.plant, machine)
        assert machine.loads.stop_share < 1.0
        assert machine.loads.lowest_clearance > -0.005
    assert len(state.done) == len(STEPS)
    assert len(turns) <= 15, "by hand"
    off = []
    for key, found in known.found.items():
        gap = gap_of(found, truth)
        assert found.error or gap == 0.0, key
        off.append(abs(gap) / (found.error or 1.0))
    assert np.mean(np.array(off) < 1.96) >= 0.9, dict(zip(known.found, np.round(off, 1), strict=True))
    assert max(off) < 5.0, dict(zip(known.found, np.round(off, 1), strict=True))


class _Swinging:
    """A swinging step that finds the machine right, or wrong."""

    title, bounds_text = "Nothing", "nothing moves"

    def __init__(self, name: str, *, failing: bool = False) -> None:
        self.name, self.failing, self.knew = name, failing, list[Configuration]()

    def swing(self, robot: object, known: Configuration, folder: Path, progress: object) -> StepResult:
        self.knew.append(known)
        if self.failing:
            raise MachineFault("swing of 60 %", "30 m/s", "26 m/s", "Look at the club.")
        return StepResult((), ("swung",))


def _measured(monkeypatch: pytest.MonkeyPatch, *steps: _Swinging) -> None:
    """Let the measuring steps be done at once, and `steps` follow."""

    def all_done(state: Commissioning, nominal: PlantParameters, *_: Any, **__: Any) -> RobotEstimate:
        return RobotEstimate(nominal, [ParameterEstimate("supply.pressure", 7e5, 100.0, "Pa", "friction")])

    monkeypatch.setattr("bench.commissioning.commissioning.commission", all_done)
    monkeypatch.setattr("bench.commissioning.commissioning.SWINGING_STEPS", steps)


@pytest.mark.slow
def test_commission_swings_use_measured_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first, last = _Swinging("swings"), _Swinging("learning")
    _measured(monkeypatch, first, last)
    assert exit_code(["commission", "--sim", "--output", str(tmp_path / "day")]) == 0
    known = last.knew[0]
    assert known.plant.supply.pressure == 7e5
    assert known.envelope.min_supply_pressure < 7e5 < known.envelope.max_supply_pressure < 8e5
    assert known.files[-1] == (tmp_path / "day" / "robot.toml").resolve()
    assert "learned.toml" in capsys.readouterr().out
    assert [step.name for step in read_state(tmp_path / "day").done] == ["inputs", "swings", "learning"]


@pytest.mark.slow
def test_commission_failed_learning_exits_with_1_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No script takes a measured robot for one that swings; its swing is repeated when resumed."""
    first, last = _Swinging("swings"), _Swinging("learning", failing=True)
    _measured(monkeypatch, first, last)
    given = ["commission", "--sim", "--output", str(tmp_path / "day")]
    assert exit_code(given) == 1
    assert (tmp_path / "day" / "robot.toml").is_file()
    wrong = read_state(tmp_path / "day").wrong
    assert wrong is not None
    assert wrong.action == "Look at the club."
    assert "Look at the club." in (tmp_path / "day" / "report.html").read_text()
    last.failing = False
    assert exit_code([*given, "--resume", "--repaired", "nothing"]) == 0
    assert (len(first.knew), len(last.knew)) == (2, 2)


@pytest.mark.slow
def test_commission_resume_edited_robot_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _measured(monkeypatch, _Swinging("limits"))
    given = ["commission", "--sim", "--output", str(tmp_path / "day")]
    robot = tmp_path / "day" / "robot.toml"
    assert exit_code(given) == 0
    written = robot.read_text()
    robot.write_text(written.replace('check = "always"', 'check = "off"'))
    for more in ([], ["--check"]):
        assert exit_code([*given, "--resume", "--repaired", "nothing", *more]) == 1
        assert "an edited file" in capsys.readouterr().err
    assert 'check = "off"' in robot.read_text()
    robot.unlink()
    assert exit_code([*given, "--resume", "--repaired", "nothing"]) == 0
    again = robot.read_text().splitlines()
    changed = [line for line in again if line not in written.splitlines()]
    assert all(line.startswith(("commissioned = ", "# as written by")) for line in changed), changed


@pytest.mark.parametrize(
    ("configured", "options", "location"),
    [
        ('[driver]\nname = "mock"\n', ["--robot", "other.toml"], "commission --robot"),
        ("", ["--regulator", "turn"], "commission --regulator"),
        ('[driver]\nname = "mock"\n', ["--sim", "--regulator", "turn"], "commission --regulator"),
        ('[driver]\nname = "mock"\n', [], "neither a program nor a terminal"),
        ("", ["--sim", "--resume"], "commission --resume"),
        ("", ["--sim", "--repaired", "hose"], "commission --repaired"),
        ('[homing]\nmethod = "index"\n', ["--sim", "--check"], "homing.method"),
        ("", ["--sim", "--check", "--output", __file__], __file__),
        ("", ["--sim", "--check", "--output", f"{__file__}/day"], __file__),
    ],
)
def test_commission_conflicting_options_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], configured: str, options: list[str], location: str
) -> None:
    file = tmp_path / "bench.toml"
    file.write_text(f'base = "shipped"\n{configured}')
    assert exit_code(
        ["--config", str(file), "commission", "--output", str(tmp_path / "day"), *options]
    ) not in (0, None)
    assert location in capsys.readouterr().err
    assert not (tmp_path / "day").exists()


class _Quick:
    """A measuring step of two seconds."""

    name, title, bounds_text = "wiring", "Quick", "0.1 open at 3 bar"

    def measure(self, machine: CommissionedMachine, known: RobotEstimate) -> Traces:
        machine.set_supply(3.0e5)
        return {"ramp": machine.run((Segment(2.0, (0.1, 0.0, 0.0), vents_shut=True),), BOUNDS)}

    def estimate(self, traces: Traces, known: RobotEstimate) -> StepResult:
        value = ParameterEstimate("supply.pressure", float(traces["ramp"].supply[-1]), 1e3, "Pa", self.name)
        return StepResult((value,), ())


@pytest.mark.live
@pytest.mark.timeout(300)
def test_commission_without_sim_moves_robot_of_driver(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swinging = _Swinging("swings")
    monkeypatch.setattr("bench.commissioning.commissioning.STEPS", (_Quick(),))
    monkeypatch.setattr("bench.commissioning.commissioning.SWINGING_STEPS", (swinging,))
    file = tmp_path / "bench.toml"
    file.write_text(f'base = "shipped"\n[bench]\nid = "day-{os.getpid()}"\ndata_dir = "{tmp_path}"\n')
    assert exit_code(["--config", str(file), "commission", "--output", str(tmp_path / "day")]) == 0
    state = read_state(tmp_path / "day")
    assert state.simulated
    assert state.values[0].value == pytest.approx(3.0e5, rel=0.02), "the regulator was turned"
    assert swinging.knew


@pytest.mark.release
@pytest.mark.timeout(1800)
def test_commission_drawn_robot_learns_planned_delivery(tmp_path: Path, configuration: Configuration) -> None:
    truth = drawn_robot(31, configuration.plant)
    file = tmp_path / "truth.toml"
    file.write_text(drawn_robot_file(truth, configuration))
    day = tmp_path / "day"
    assert exit_code(["commission", "--sim", "--robot", str(file), "--output", str(day)]) == 0, (
        day / "report.html"
    ).read_text()
    state, learned = read_state(day), load_profile(day / "learned.toml")
    assert [step.name for step in state.done] == [step.name for step in ALL_STEPS]
    assert "All 9 steps done" in (day / "report.html").read_text()
    for limits in ("swing.limits.toml", "learned.limits.toml"):
        assert load_limits(day / limits).draws == DRAWS
    # The learned swing, on the robot itself, as the plant knows it.
    known = load_configuration(day / "robot.toml")
    assert known.swing.profile == str((day / "learned.toml").resolve())
    bench = bench_of(known, learned)
    made = Series(bench, truth).swing(learned)
    assert made.delivery is not None
    delivered, planned = figures_of(made.delivery), load_profile(day / "swing.toml").delivery
    assert abs(delivered.strike) < 0.003
    assert delivered.speed == pytest.approx(planned["head_speed_mps"], rel=0.005)
    assert np.degrees(delivered.attack) == pytest.approx(planned["attack_angle_deg"], abs=0.4)
    assert np.degrees(delivered.lean) == pytest.approx(planned["shaft_lean_deg"], abs=0.4)
