"""Records replay to the last bit; a changed gain, estimator or envelope shows.

The reference records hold the controller's output when they were made, so that no change of it goes
unnoticed. Is the change meant? `make reference` renews them (`tests/replay/renew.py`).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.base.lifecycle import Cause, Phase, Reaction, Request
from bench.control.law.gain_table import DAMPING, DERIVATIVE, INTEGRAL, PROPORTIONAL
from bench.control.settings import SIMULATED, HomingSettings, build_controller
from bench.control.step_records import ControlParameters
from bench.loop.loop import Cycle, CycleArray
from bench.loop.snapshot import SNAPSHOT, pack_snapshot
from bench.records.telemetry.cycle_record import FIELDS
from bench.records.telemetry.record_file import read_swing, write_swing
from bench.records.telemetry.swing_metadata import begin_of, since, snapshot_entry
from bench.simulation.lockstep import Lockstep
from bench.simulation.replay import DECIDED, INPUTS, MEASURED, Replay, replay_cycles
from bench.simulation.simulated_bench import Bench, PoweredBench
from drivers.base import PASSIVE, Command, DriverError, Readings
from drivers.base.compiled import new_record
from sim.driver import SimDriver
from tests.bench.simulation.driver_loop import DriverLoop
from tests.conftest import Run
from tests.replay.renew import STOP, SWING, reference_bench
from tests.sampling import release_except

Change = Callable[[ControlParameters], None]
Record = tuple[np.ndarray[Any, Any], dict[str, Any]]


def wrong(replay: Replay) -> dict[str, int | None]:
    """Return the fields that differ and the first tick of each."""
    return {d.field: d.tick for d in replay.differences() if d.ticks}


@pytest.fixture(scope="module")
def swing() -> Record:
    return read_swing(SWING)


@pytest.fixture(scope="module")
def stop() -> Record:
    return read_swing(STOP)


def test_record_fields_are_input_decided_or_measured() -> None:
    names = [field.name for field in FIELDS]
    assert sorted([*INPUTS, *DECIDED, *MEASURED]) == sorted(names)


@pytest.mark.parametrize("path", [SWING, STOP])
def test_replay_reference_record_shows_no_difference(path: Path) -> None:
    replay = replay_cycles(*read_swing(path), path.name)
    assert len(replay.recorded) > 700
    assert wrong(replay) == {}
    assert not replay.defaults, "the record is older than these settings: make reference"


def test_reference_records_are_small_and_cover_phases(swing: Record, stop: Record) -> None:
    assert max(SWING.stat().st_size, STOP.stat().st_size) < 1e6
    assert set(swing[0]["phase"]) == {p for p in Phase if p not in {Phase.STANDING, Phase.HOMING}}
    assert {Reaction.NONE, Reaction.BRAKE} == set(stop[0]["reaction"])
    steps = np.abs(np.diff(swing[0]["applied_valve"], axis=0))
    assert np.sum(steps > 0.399) > 10  # the slew limit is at work
    assert np.sum(np.abs(swing[0]["applied_valve"]) == 1.0) > 10  # and the greatest opening


# Changes that must show ------------------------------------------------------------------------------


def scale(record: str, field: str, joint: int | None, factor: float = 1.0 + 1e-6) -> Change:
    def change(parameters: ControlParameters) -> None:
        values = getattr(parameters, record)[field][0]
        if joint is None:
            getattr(parameters, record)[field] = values * factor
        else:
            values[joint] *= factor

    return change


def scale_gain(row: int, joint: int) -> Change:
    def change(parameters: ControlParameters) -> None:
        parameters.pid["table"][0][..., row, joint] *= 1.0 + 1e-6

    return change


def shift_profile(parameters: ControlParameters) -> None:
    parameters.angle[500, 2] += 1e-6


def delay_impact(parameters: ControlParameters) -> None:
    first = int(np.argmax(parameters.phase == Phase.IMPACT))
    parameters.phase[first] = Phase.COMMITTED


CHANGES: dict[str, tuple[Path, Change, str]] = {
    "proportional": (SWING, scale_gain(PROPORTIONAL, 0), "proportional"),
    "integral": (SWING, scale_gain(INTEGRAL, 1), "integral"),
    "derivative": (SWING, scale_gain(DERIVATIVE, 2), "derivative"),
    "damping": (SWING, scale_gain(DAMPING, 0), "feedforward"),
    "brake gain, follow-through": (SWING, scale("control", "brake_gain", 1), "desired_valve"),
    "brake gain, stop": (STOP, scale("control", "brake_gain", 1), "desired_valve"),
    "brake damping": (STOP, scale("control", "brake_damping", 0), "desired_valve"),
    "brake fade": (STOP, scale("control", "brake_fade_speed", 2), "desired_valve"),
    "move speed": (SWING, scale("control", "move_speed", None), "reference_angle"),
    "process noise": (SWING, scale("estimator", "density", None), "velocity"),
    "encoder zero": (SWING, lambda p: p.encoder["zero_count"].__iadd__(0.001), "angle"),
    "slew": (SWING, scale("envelope", "max_slew", None), "applied_valve"),
    "max opening": (SWING, scale("envelope", "max_opening", None, 0.999), "applied_valve"),
    "max speed": (SWING, scale("envelope", "max_speed", None, 0.5), "reaction"),
    "following error": (SWING, scale("envelope", "max_following_error", None, 0.05), "cause"),
    "profile": (SWING, shift_profile, "reference_angle"),
    "impact window": (SWING, delay_impact, "phase"),
}
"""The change, the record that shows it, and a field in which it must."""


@pytest.mark.parametrize("name", CHANGES)
def test_replay_changed_controller_shows_difference(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path, change, field = CHANGES[name]

    def changed(*arguments: Any, **settings: Any) -> ControlParameters:
        parameters = build_controller(*arguments, **settings)
        change(parameters)
        return parameters

    monkeypatch.setattr("bench.simulation.replay.build_controller", changed)
    assert field in wrong(replay_cycles(*read_swing(path), path.name))


# Records of any kind --------------------------------------------------------------------------------


class Faulty(SimDriver):
    """The software plant, whose readings fail or miss encoders at some times; it may turn passive itself."""

    def __init__(self, bench: Bench, failing: range, invalid: range, passive: range) -> None:
        super().__init__(bench.plant)
        self.count, self.failing, self.invalid, self.passive = 0, failing, invalid, passive

    @property
    def operational(self) -> bool:
        return self.count not in self.passive

    def read(self, time: float) -> Readings:
        self.count += 1
        readings = super().read(time)
        if self.count in self.failing:
            raise DriverError("no answer")
        if self.count in self.invalid:
            return readings._replace(encoder_valid=(True, False, True))
        return readings

    def write(self, command: Command) -> Command:
        return super().write(command if self.operational else PASSIVE)


NOTHING = range(0)
FAULTS: dict[str, dict[str, Any]] = {
    "nothing": {},
    "single lost samples": {"invalid": range(5100, 5800, 40)},
    "a lost encoder": {"invalid": range(5200, 9000)},
    "a driver that raises once": {"failing": range(5200, 5201)},
    "a driver that raises": {"failing": range(5300, 9000)},
    "a device gone passive": {"passive": range(5250, 9000)},
    "permissions lost": {"told": {5200: ("lease_held", False), 5400: ("supervisor_alive", False)}},
    "missed ticks": {"missed": {5150: 3, 5300: 1, 5350: 7}},
    "an emergency stop": {"requests": {5250: Request.EMERGENCY_STOP}},
    "refused and other requests": {"requests": {5100: Request.ARM, 5200: Request.TEE, 5900: Request.RESET}},
    "a gap and a reset": {"missed": {5200: 30}, "requests": {6800: Request.RESET, 6900: Request.ACCESS}},
}


def record_of(
    failing: range = NOTHING,
    invalid: range = NOTHING,
    passive: range = NOTHING,
    told: dict[int, tuple[str, bool]] | None = None,
    missed: dict[int, int] | None = None,
    requests: dict[int, Request] | None = None,
) -> Record:
    """Return 7000 ticks of the cycle around a faulty driver, from arming on, at a loop's odd clock."""
    bench = reference_bench()
    driver = Faulty(bench, failing, invalid, passive)
    kept = CycleArray(7000)
    parameters = build_controller(bench.plant, bench.profile, lifecycle=SIMULATED)
    cycle = Cycle(driver, parameters, kept, name="faulty")
    control, snapshot = cycle.state.control, new_record(SNAPSHOT)
    asked = {20: Request.ARM, 5000: Request.SWING} | (requests or {})
    driver.open()
    grid = 0
    for tick in range(7000):
        grid += 1 + (missed or {}).get(tick, 0)
        control["tick"] = grid - 1
        if tick in asked:
            control["request"], control["request_number"] = asked[tick], tick
        if told and tick in told:
            name, value = told[tick]
            control[name] = value
        cycle.run_tick(123456.789 + grid * 1e-3)
        if tick == 4999:
            pack_snapshot(cycle.state, snapshot)
    driver.close()
    cycles = kept.cycles[4900:]
    begin = begin_of(cycles)
    metadata = bench.metadata({"begin": begin, "snapshot": snapshot_entry(snapshot), "replayable": True})
    return since(cycles, begin), json.loads(json.dumps(metadata))


@pytest.mark.parametrize(
    "name", release_except(FAULTS.keys() - {"nothing", "a driver that raises once"}, FAULTS)
)
def test_replay_fault_record_is_bit_exact(name: str) -> None:
    cycles, metadata = record_of(**FAULTS[name])
    assert Phase.HOLD in cycles["phase"][:100], "the robot is to be at its address"
    replay = replay_cycles(cycles, metadata, name)
    assert len(replay.recorded) == 2000
    assert [(d.field, d.greatest) for d in replay.differences() if d.greatest] == []
    tripped = name not in {"nothing", "single lost samples", "missed ticks", "refused and other requests"}
    assert bool(replay.recorded["cause"].any()) is tripped


def test_replay_leaves_record_unchanged(swing: Record) -> None:
    before = swing[0].tobytes()
    replay = replay_cycles(*swing, "swing")
    assert swing[0].tobytes() == before
    for name in INPUTS:
        assert np.array_equal(replay.recorded[name], replay.replayed[name], equal_nan=True)


def test_replay_swing_series_of_each_stepper_shows_no_difference(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = reference_bench()
    for stepper in (Lockstep, DriverLoop):
        monkeypatch.setattr("bench.simulation.simulated_bench.Lockstep", stepper)
        powered = PoweredBench(bench)
        assert powered.arm()
        for ball in (bench.plant.ball, None):
            result = powered.swing(ball)
            metadata = json.loads(json.dumps(bench.metadata(result.replay_metadata())))
            replay = replay_cycles(result.cycles, metadata, "swing")
            assert len(replay.recorded) == len(result.cycles) - 1
            assert [d.field for d in replay.differences(0.0) if d.ticks] == []


# How it compares ------------------------------------------------------------------------------------


def tampered(replay: Replay, field: str, value: float, tick: int = 100) -> Replay:
    recorded = since(replay.recorded, 0.0)
    recorded[field][tick] = value
    return replace(replay, recorded=recorded)


@pytest.mark.parametrize(
    ("field", "value", "differs"),
    [
        ("angle", np.nan, True),
        ("angle", np.inf, True),
        ("tee", 0, True),
        ("phase", int(Phase.RETURN), True),
        ("cause", int(Cause.GROUND), True),
        ("work_time", 9.0, False),
        ("plant_angle", 9.0, False),
    ],
)
def test_replay_differences_changed_value_gives_field_and_tick(
    swing: Record, field: str, value: float, differs: bool
) -> None:
    replay = tampered(replay_cycles(*swing, "swing"), field, value)
    found = [d for d in replay.differences() if d.ticks]
    assert [d.field for d in found] == [field] * differs
    for d in found:
        at = replay.recorded[100]
        assert (d.ticks, d.tick, d.time) == (1, at["tick"], at["time"])


def test_replay_tolerance_is_absolute_plus_relative(swing: Record) -> None:
    replay = replay_cycles(*swing, "swing")
    angle = float(replay.replayed["angle"][100, 2])
    assert angle > 4.0
    for apart, differs in ((0.9 * (1 + angle) * 1e-6, False), (1.1 * (1 + angle) * 1e-6, True)):
        recorded = since(replay.recorded, 0.0)
        recorded["angle"][100, 2] += apart
        (found,) = [d for d in replace(replay, recorded=recorded).differences(1e-6) if d.field == "angle"]
        assert (found.ticks, found.component if differs else "wrist") == (int(differs), "wrist")
        assert found.greatest == pytest.approx(apart, rel=1e-3)


# What cannot be replayed ------------------------------------------------------------------------------


def without(metadata: dict[str, Any], *keys: str) -> dict[str, Any]:
    copy = json.loads(json.dumps(metadata))
    node = copy
    for key in keys[:-1]:
        node = node[key]
    del node[keys[-1]]
    return copy  # type: ignore[no-any-return]


def test_replay_missing_setting_takes_default(swing: Record) -> None:
    metadata = without(
        without(swing[1], "configuration", "control", "impact_speed_drop"), "configuration", "homing"
    )
    replay = replay_cycles(swing[0], metadata, "swing")
    assert set(replay.defaults) == {
        "control.impact_speed_drop",
        *(f"homing.{setting.name}" for setting in fields(HomingSettings)),
    }
    assert wrong(replay) == {}


@pytest.mark.parametrize(
    ("keys", "value", "location"),
    [
        (("snapshot",), None, "swing: snapshot"),
        (("snapshot", "layout"), "0123", "swing: snapshot"),
        (("snapshot", "data"), "AAAA", "swing: snapshot"),
        (("replayable",), False, "swing"),
        (("begin",), None, "swing: begin"),
        (("profile", "data"), "AAAA", "swing: profile"),
        (("configuration",), None, "swing: configuration"),
    ],
)
def test_replay_invalid_metadata_reports_location(
    swing: Record, keys: tuple[str, ...], value: Any, location: str
) -> None:
    metadata = json.loads(json.dumps(swing[1]))
    node = metadata
    for key in keys[:-1]:
        node = node[key]
    node[keys[-1]] = value
    with pytest.raises(BenchError) as refusal:
        replay_cycles(swing[0], metadata, "swing")
    assert refusal.value.location == location


def test_replay_invalid_settings_reports_all(swing: Record) -> None:
    metadata = json.loads(json.dumps(swing[1]))
    metadata["configuration"]["control"]["rest_time"] = -1.0
    metadata["configuration"]["envelope"]["glue"] = 3
    metadata["configuration"]["plant"]["robot"]["l12"] = "long"
    with pytest.raises(ExceptionGroup) as group:
        replay_cycles(swing[0], metadata, "swing")
    places = [error.location for error in group.value.exceptions if isinstance(error, BenchError)]
    assert [location.split(": ")[-1] for location in places] == [
        "plant.robot.l12",
        "control.rest_time",
        "envelope.glue",
    ]


def test_replay_snapshot_of_other_tick_raises(swing: Record) -> None:
    with pytest.raises(BenchError, match="tick"):
        replay_cycles(swing[0][5:], swing[1], "swing")
    with pytest.raises(BenchError, match="tick"):
        replay_cycles(swing[0][:1], swing[1], "swing")


# The command ------------------------------------------------------------------------------------------


def test_replay_command_equal_record_reports_equal(run: Run) -> None:
    code, text, _ = run("replay", SWING)
    assert (code, "Equal: today's controller repeats the record." in text) == (0, True)


def test_replay_command_different_record_reports_first_tick(tmp_path: Path, swing: Record, run: Run) -> None:
    cycles = since(swing[0], 0.0)
    cycles["phase"][700], cycles["angle"][900] = Phase.HOLD, np.nan
    metadata = {k: v for k, v in swing[1].items() if k not in {"schema_version", "enumerations"}}
    path = tmp_path / "tampered.parquet"
    write_swing(path, cycles, metadata)
    code, text, _ = run("replay", path)
    assert code == 1
    assert f"Different: first in tick {cycles['tick'][700]}, phase." in text
    assert "HOLD" in text
    code, text, _ = run("replay", path, "--json")
    assert code == 1
    answer = json.loads(text)
    assert (answer["equal"], answer["ticks"]) == (False, len(cycles) - 1)
    found = {field["field"]: field for field in answer["fields"]}
    assert set(found) == DECIDED
    assert [name for name, field in found.items() if field["ticks"]] == ["phase", "angle"]
    assert (found["angle"]["tick"], found["angle"]["greatest"]) == (cycles["tick"][900], None)


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["nowhere.parquet"], 2, "no such file"),
        ([__file__], 2, "unreadable"),
        ([], 2, "RECORD"),
    ],
)
def test_replay_command_invalid_usage_exits_with_error(
    arguments: list[str], code: int, text: str, run: Run
) -> None:
    outcome = run("replay", *arguments)
    assert (outcome.code, text in outcome.words) == (code, True)
