"""Swings of the simulated bench: results, stored records, and state after Ctrl-C."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bench.simulation.simulated_bench
from bench.base.errors import ExitCode, Refused
from bench.base.interrupt import deferred_interrupt
from bench.base.lifecycle import CAUSE_TEXT, Cause, Phase, Reaction
from bench.commands.cli import main
from bench.control.settings import EnvelopeSettings
from bench.records.shot.shot import ShotStatus
from bench.records.telemetry.record_file import read_swing, write_swing
from bench.simulation.lockstep import Lockstep
from bench.simulation.simulated_bench import Bench, PoweredBench, SwingResult, simulate_swing
from bench.swing.profile import Profile
from drivers.base import PASSIVE
from drivers.base.records import unpack_command
from sim.ball import Ball
from tests.bench.simulation.driver_loop import DriverLoop
from tests.compiled_only import needs_speed
from tests.sampling import release_except

pytestmark = needs_speed

SOFT = Ball(name="soft", restitution_factor=0.9)
NEVER = 10**9


@pytest.fixture(scope="module")
def robot(default_profile: Profile) -> Bench:
    return Bench(default_profile)


def swung(robot: Bench) -> list[SwingResult]:
    """Return four swings after one arming, the third without a ball."""
    powered = PoweredBench(robot)
    assert powered.arm()
    return [powered.swing(ball) for ball in (Ball(), SOFT, None, Ball())]


@pytest.fixture(scope="module")
def series(robot: Bench) -> list[SwingResult]:
    return swung(robot)


@pytest.fixture(params=release_except({Lockstep}, [DriverLoop, Lockstep]))
def steppers(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return the steppers that the simulation makes: Python cycle and compiled."""
    made: list[Any] = []

    def make(*arguments: object) -> Any:
        made.append(request.param(*arguments))
        return made[-1]

    monkeypatch.setattr(bench.simulation.simulated_bench, "Lockstep", make)
    return made


class ControlC:
    """Asks as the event does, and sends this process a SIGINT at question number `at`."""

    def __init__(self, wish_is_made: Callable[[], bool], at: int) -> None:
        self.wish_is_made, self.at, self.asked = wish_is_made, at, 0

    def __call__(self) -> bool:
        self.asked += 1
        if self.asked == self.at:
            signal.raise_signal(signal.SIGINT)
        return self.wish_is_made()


def test_powered_bench_ball_gives_valid_shot_with_flight(
    series: list[SwingResult], default_profile: Profile
) -> None:
    result = series[0]
    assert (result.status, result.reason, result.cause) == (ShotStatus.VALID, "", Cause.NONE)
    assert result.delivery is not None
    assert result.launch is not None
    assert result.flight is not None
    assert result.contact_time is not None
    assert result.delivery.speed == pytest.approx(default_profile.delivery["head_speed_mps"], rel=0.05)
    assert result.launch.speed > 1.3 * result.delivery.speed
    assert 100 < result.flight.carry < 300
    assert result.loads.peak_head_speed >= result.delivery.speed - 0.5
    assert result.loads.stop_energy.shape == (3, 2)
    assert 4e5 < result.loads.peak_pressure.max() < 12e5
    assert result.loads.lowest_clearance > 0


def test_powered_bench_record_spans_hold_to_hold_from_time_zero(series: list[SwingResult]) -> None:
    for result in series:
        cycles = result.cycles
        assert 0.0 <= cycles["time"][0] < 1e-3
        assert np.all(np.diff(cycles["tick"]) == 1)
        since = cycles["time"] - cycles["time"][0]
        assert since == pytest.approx(np.arange(len(cycles)) * 1e-3, abs=1e-9)
        age = np.repeat(cycles["time"][:, None], 3, axis=1) - cycles["encoder_time"]
        assert age == pytest.approx(cycles["encoder_age"], abs=1e-9)
        assert cycles["phase"][0] == cycles["phase"][-1] == Phase.HOLD
        assert set(cycles["phase"]) == {p for p in Phase if p not in {Phase.STANDING, Phase.HOMING}}
    first = series[0]
    assert first.contact_time is not None
    before, after = (int(first.contact_time / 1e-3) + k for k in (-1, 3))
    assert first.cycles["ball_present"][before]
    assert not first.cycles["ball_present"][after]


def test_powered_bench_soft_ball_is_slower_and_missing_ball_fails(series: list[SwingResult]) -> None:
    assert [r.status for r in series] == [
        ShotStatus.VALID,
        ShotStatus.VALID,
        ShotStatus.FAILED,
        ShotStatus.VALID,
    ]
    normal, soft, none, again = series
    assert none.reason == "no ball on the tee"
    assert [none.delivery, none.launch, none.flight, none.contact_time] == [None] * 4
    assert not none.cycles["ball_present"].any()
    assert normal.launch is not None
    assert soft.launch is not None
    assert again.launch is not None
    assert soft.launch.speed < 0.99 * again.launch.speed
    assert again.launch.speed == pytest.approx(normal.launch.speed, rel=0.03)


def test_simulate_swing_equals_first_swing_of_series(robot: Bench, series: list[SwingResult]) -> None:
    assert simulate_swing(robot).cycles.tobytes() == series[0].cycles.tobytes()


def test_simulated_bench_metadata_stores_configuration_and_versions(
    robot: Bench, series: list[SwingResult], tmp_path: Path
) -> None:
    path = tmp_path / "swing.parquet"
    write_swing(path, series[0].cycles, robot.metadata({"shot": {"number": 1, "ball": "standard"}}))
    cycles, metadata = read_swing(path)
    assert cycles.tobytes() == series[0].cycles.tobytes()
    assert metadata["shot"] == {"number": 1, "ball": "standard"}
    assert metadata["profile"]["name"] == robot.profile.name
    assert metadata["seed"] == robot.plant.seed
    assert metadata["configuration"]["plant"]["supply"]["pressure"] == robot.plant.supply.pressure
    assert {"golfbench", "numpy", "numba", "python"} <= set(metadata["versions"])


def test_swing_result_shot_fills_shot_table_row(series: list[SwingResult]) -> None:
    now = datetime(2020, 1, 2, tzinfo=UTC)
    record = series[1].shot(2, block=1, position=2, time_utc=now)
    assert (record.shot.shot, record.shot.position, record.shot.ball, record.shot.club) == (
        2,
        2,
        "soft",
        "driver",
    )
    assert record.valid
    assert record.flight is series[1].flight
    assert record.shot.delivery_source == "simulated"
    missed = series[2].shot(3, time_utc=now).shot
    assert (missed.status, missed.ball, missed.carry_m) == (ShotStatus.FAILED, "", None)


def test_simulate_swing_envelope_trip_gives_failed_shot(robot: Bench) -> None:
    result = simulate_swing(replace(robot, envelope=EnvelopeSettings(max_speed=(6.0, 6.0, 48.0))))
    assert (result.status, result.cause) == (ShotStatus.FAILED, Cause.SHOULDER_SPEED)
    assert result.reason == CAUSE_TEXT[Cause.SHOULDER_SPEED]
    assert result.cycles["phase"][-1] == Phase.STANDING
    assert not result.cycles["supply_enable"][-1]


def test_simulate_swing_failed_flight_gives_failed_shot(
    robot: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("the ball is still in the air after 60 s")

    monkeypatch.setattr(bench.simulation.simulated_bench, "fly", fail)
    result = simulate_swing(robot)
    assert (result.status, result.flight) == (ShotStatus.FAILED, None)
    assert "still in the air" in result.reason
    assert result.launch is not None


@pytest.mark.usefixtures("steppers")
def test_simulate_swing_unreachable_address_is_refused(robot: Bench) -> None:
    beyond = replace(robot.profile, angle=robot.profile.angle + [0.0, 0.0, 0.6])
    with pytest.raises(Refused, match=r"arming with profile") as refused:
        simulate_swing(replace(robot, profile=beyond))
    assert any(text in refused.value.found for text in CAUSE_TEXT.values())
    assert "hold at address" in refused.value.expected


def test_simulate_swing_open_emergency_stop_circuit_is_refused(
    robot: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Pressed(Lockstep):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            self.plant_state["emergency_stop_clear"] = False

    monkeypatch.setattr(bench.simulation.simulated_bench, "Lockstep", Pressed)
    with pytest.raises(Refused, match=r"refused"):
        simulate_swing(robot)


@pytest.fixture(scope="module")
def swing_ticks(series: list[SwingResult]) -> int:
    return len(series[0].cycles) - int(np.argmax(series[0].cycles["phase"] == Phase.BACKSWING))


@pytest.fixture(scope="module")
def first_question(robot: Bench, swing_ticks: int) -> int:
    """Return the number of the first question in a swing; there is one every 200 ms."""
    counted = ControlC(lambda: False, NEVER)
    simulate_swing(robot, stop=counted)
    return counted.asked - swing_ticks // 200


@pytest.mark.parametrize(
    "seconds", release_except({-1.5, 0.7, 1.4, 2.5}, [-1.5, 0.2, 0.7, 1.2, 1.4, 1.7, 2.5])
)
def test_simulate_swing_interrupt_stops_swing_and_keeps_record(
    robot: Bench,
    swing_ticks: int,
    first_question: int,
    steppers: list[Any],
    tmp_path: Path,
    seconds: float,
) -> None:
    """Times count from the swing's request; before it the robot is still being armed."""
    results: list[SwingResult] = []

    def work() -> None:
        with deferred_interrupt() as wish:
            stop = ControlC(wish.is_made, first_question + round(seconds / 0.2))
            result = simulate_swing(robot, stop=stop)
            write_swing(tmp_path / "swing.parquet", result.cycles, robot.metadata())
            results.append(result)

    with pytest.raises(KeyboardInterrupt):
        work()
    for stepper in steppers:
        passive = isinstance(stepper, Lockstep) and unpack_command(stepper.command)
        assert (passive or stepper.driver.applied) == PASSIVE
    if seconds < 0:
        assert not results
        return
    assert len(results) == 1
    result = results[0]
    assert result.interrupted
    assert (result.status, result.reason) == (ShotStatus.FAILED, "interrupted by Ctrl-C")
    assert result.cause is Cause.OPERATOR_STOP
    assert result.cycles["reaction"].max() >= Reaction.COMPLETE
    assert result.cycles["phase"][-1] == Phase.STANDING
    assert len(result.cycles) < 300 + swing_ticks + 4000
    stored, _ = read_swing(tmp_path / "swing.parquet")
    assert stored.tobytes() == result.cycles.tobytes()


def test_command_line_interrupt_exits_with_130(
    robot: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def swing(*_: object) -> None:
        with deferred_interrupt() as wish:
            result = simulate_swing(robot, stop=ControlC(wish.is_made, 24))
            write_swing(tmp_path / "swing.parquet", result.cycles, robot.metadata())

    monkeypatch.setattr("bench.commands.machine.doctor_bench.probes", swing)  # any command will do
    with pytest.raises(SystemExit) as end:
        main(["doctor"])
    assert end.value.code == ExitCode.INTERRUPTED
    assert not list(tmp_path.glob("*.partial"))


def test_simulate_swing_interrupt_before_start_makes_no_swing(robot: Bench) -> None:
    with pytest.raises(KeyboardInterrupt):
        simulate_swing(robot, stop=lambda: True)
