"""The cycle around a driver: what reaches the record, and what happens in the tick that fails."""

from __future__ import annotations

import gc
import tracemalloc
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from bench.base.clock import FreeClock
from bench.base.lifecycle import Answer, Cause, Phase, Reaction, Refusal, Request, State
from bench.control.settings import (
    ControlSettings,
    EnvelopeSettings,
    ModelSettings,
    PidSettings,
    build_controller,
)
from bench.control.step_records import ControlParameters, new_control_state
from bench.loop.loop import Cycle, CycleArray, Loop, bring_to_rest
from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.ring import RingWriter
from bench.swing.profile import Profile
from drivers.base import PASSIVE, Command, DriverError, Readings
from drivers.base.compiled import new_record
from drivers.base.records import pack_readings
from drivers.mock import MockDriver
from sim.driver import SimDriver
from sim.plant import PlantParameters

ADDRESS = np.array([0.1, 4.05, 6.1])
TOP = np.array([-0.7, 3.8, 5.4])
PERIOD = 1e-3
PLANT = PlantParameters()
UNMODELLED = EnvelopeSettings(model=ModelSettings(check="off"))
WEIGHTLESS = ControlSettings(
    gains="hand",
    pid=PidSettings((1.0,) * 3, (0.0,) * 3, (0.0,) * 3),
    damping=(0.0,) * 3,
    brake_gain=(0.02,) * 3,
    brake_damping=(0.0,) * 3,
    move_gain=(1 / 12, 1 / 10, 1 / 30),
    precharge_opening=0.01,
)
"""Gains for a robot whose joints have the speed that the valves say, at once."""


class Faulty(MockDriver):
    """A mock whose next call may fail, and that applies less than it is asked."""

    def __init__(self) -> None:
        super().__init__(start=(0.05, 4.0, 6.0))
        self.fail_read: BaseException | None = None
        self.fail_write: BaseException | None = None
        self.readings: object = None
        self.strongest = 1.0
        self.passive = 0
        self.obeys = True

    @property
    def operational(self) -> bool:
        return self.obeys

    def read(self, time: float) -> Readings:
        if self.fail_read:
            raise self.fail_read
        taken = super().read(time)
        return taken if self.readings is None else self.readings  # type: ignore[return-value]

    def write(self, command: Command) -> Command:
        if self.fail_write:
            raise self.fail_write
        bounded = tuple(max(-self.strongest, min(self.strongest, v)) for v in command.valve)
        return super().write(command._replace(valve=bounded))  # type: ignore[arg-type]

    def make_passive(self) -> None:
        self.passive += 1
        super().make_passive()


@pytest.fixture(scope="module")
def parameters() -> ControlParameters:
    """Up to the top in 0.4 s, hold, and down to the address again without a ball."""
    part = np.linspace(0, 1, 400)[:, None]
    way = part**3 * (10 - 15 * part + 6 * part**2)
    up, top = ADDRESS + (TOP - ADDRESS) * way, np.tile(TOP, (200, 1))
    angle = np.vstack([up, top, up[::-1]])
    velocity = np.gradient(angle, PERIOD, axis=0)
    n = len(angle)
    begins = (0, 1, 400, 600, n - 3, n - 2, n - 1)
    profile = Profile(
        "mock",
        "",
        "",
        "",
        PERIOD,
        begins,
        angle,
        velocity,
        velocity * WEIGHTLESS.move_gain,
        20,
        np.zeros((n // 20 + 1, 6)),
        (0.25, -1.56),
        0.9,
    )
    return build_controller(PLANT, profile, WEIGHTLESS, UNMODELLED)


@pytest.fixture
def driver() -> Faulty:
    made = Faulty()
    made.open()
    return made


@pytest.fixture
def loop(driver: Faulty, parameters: ControlParameters) -> Loop:
    return Loop(driver, parameters, FreeClock(PERIOD), name="faulty")


@pytest.fixture
def holding(loop: Loop) -> Loop:
    """Arm the mock and wait for the address."""
    loop.advance(5)
    loop.advance(1, Request.ARM)
    for _ in range(60):
        loop.advance(100)
        if loop.phase is Phase.HOLD:
            return loop
    pytest.fail(f"no hold: {loop.phase!r}, cause {control(loop)['cause']}")


def control(loop: Loop) -> Any:
    return loop.state.control[0]


def phase(loop: Loop) -> int:
    return int(control(loop)["phase"])


def test_loop_mock_driver_arms_swings_and_stops(holding: Loop, driver: Faulty) -> None:
    swing = holding.advance(1200, Request.SWING)
    assert {Phase.BACKSWING, Phase.TOP, Phase.DOWNSWING, Phase.RETURN} <= set(swing["phase"])
    assert control(holding)["cause"] == Cause.NONE
    assert np.all(np.abs(swing["applied_valve"]) <= 1)
    assert np.isnan(swing["plant_angle"]).all()
    assert np.diff(swing["tick"]).tolist() == [1] * 1199
    assert swing["time"].tolist() == [k * PERIOD for k in swing["tick"] - 1]
    records = np.concatenate(bring_to_rest(holding, 3000))
    assert phase(holding) == Phase.STANDING
    assert records["cause"][-1] == Cause.OPERATOR_STOP
    assert driver.applied == PASSIVE
    assert driver.passive == 3


def test_cycle_record_holds_applied_valve_command(holding: Loop, driver: Faulty) -> None:
    driver.strongest = 0.01
    cycles = holding.advance(200, Request.SWING)
    assert np.abs(cycles["desired_valve"]).max() > 0.02
    assert np.abs(cycles["applied_valve"]).max() == 0.01


def test_cycle_failed_reading_triggers_open_loop_brake_in_same_tick(holding: Loop, driver: Faulty) -> None:
    holding.advance(150, Request.SWING)
    assert phase(holding) == Phase.BACKSWING
    driver.fail_read = DriverError("bus off")
    failed = holding.advance(1)[0]
    assert (failed["reaction"], failed["cause"]) == (Reaction.BLIND_BRAKE, Cause.EXCEPTION)
    assert not failed["encoder_valid"].any()
    assert not failed["emergency_stop_clear"]
    assert np.isnan(failed["supply_pressure"])
    assert holding.read_error is driver.fail_read
    driver.fail_read = OSError("later")
    for _ in range(30):
        holding.advance(100)
    assert phase(holding) == Phase.STANDING
    assert driver.applied == PASSIVE
    assert str(holding.read_error) == "bus off"
    assert control(holding)["cause"] == Cause.EXCEPTION


def test_loop_failed_readings_at_standstill_refuse_arm_until_homing(loop: Loop, driver: Faulty) -> None:
    loop.advance(5)
    driver.fail_read = DriverError("bus off")
    loop.advance(1, Request.ARM)
    assert control(loop)["answer"] == Answer.REFUSED
    # ESTOP, as nothing said the circuit is closed.
    assert (control(loop)["cause"], control(loop)["state"]) == (Cause.EXCEPTION, State.ESTOP)
    driver.fail_read = None
    loop.advance(1, Request.ARM)
    assert control(loop)["answer"] == Answer.REFUSED
    loop.advance(1, Request.RESET)
    assert control(loop)["state"] == State.SAFE
    loop.advance(1, Request.ARM)
    assert control(loop)["answer"] == Answer.REFUSED


def test_loop_failed_readings_keep_first_cause(holding: Loop, driver: Faulty) -> None:
    driver.obeys = False
    for _ in range(40):
        holding.advance(100)
    assert (phase(holding), control(holding)["state"]) == (Phase.STANDING, State.FAULT)
    driver.fail_read = DriverError("closed: it could not be opened again")
    shown = holding.advance(3)
    assert set(shown["cause"]) == {Cause.DEVICE_PASSIVE}
    assert control(holding)["latest_cause"] == Cause.EXCEPTION
    assert control(holding)["state"] == State.ESTOP  # nothing says that the circuit is closed


@pytest.mark.parametrize("wrong", [type(None), (), "readings"])
def test_cycle_invalid_readings_type_triggers_open_loop_brake(
    holding: Loop, driver: Faulty, wrong: object
) -> None:
    driver.readings = wrong
    assert holding.advance(1)["reaction"][0] == Reaction.BLIND_BRAKE
    assert holding.read_error is not None


@pytest.mark.parametrize("error", [DriverError("valve island gone"), OSError("no buffer space")])
def test_cycle_failed_write_makes_passive_in_same_tick(
    holding: Loop, driver: Faulty, error: Exception
) -> None:
    holding.advance(150, Request.SWING)
    kept = CycleArray(1)
    holding.publish = kept
    driver.fail_write = error
    with pytest.raises(type(error)) as raised:
        holding.run_tick(holding.clock.wait())
    told = [str(raised.value), *getattr(raised.value, "__notes__", [])]
    assert any("driver 'faulty'" in text and "passive command was sent" in text for text in told)
    assert str(error) in told[0]
    assert driver.passive == 1
    assert driver.applied == PASSIVE
    assert (kept.cycles["cause"][0], kept.cycles["reaction"][0]) == (Cause.EXCEPTION, Reaction.PASSIVE)
    assert not kept.cycles["applied_valve"].any()
    assert not kept.cycles["supply_enable"][0]


def test_loop_exception_refuses_arm_until_reset(holding: Loop, driver: Faulty) -> None:
    driver.fail_write = DriverError("gone")
    with pytest.raises(DriverError):
        holding.advance(1)
    driver.fail_write = None
    holding.advance(1, Request.ARM)
    assert control(holding)["answer"] == Answer.REFUSED
    assert driver.applied == PASSIVE
    holding.advance(100)  # a robot that has just been let go is not still
    holding.advance(1, Request.RESET)
    assert (control(holding)["answer"], control(holding)["cause"]) == (Answer.ACCEPTED, Cause.NONE)
    holding.advance(1, Request.ARM)
    assert control(holding)["answer"] == Answer.ACCEPTED


def test_loop_exception_after_emergency_stop_keeps_first_cause(holding: Loop, driver: Faulty) -> None:
    driver.emergency_stop_clear = False
    holding.advance(1)
    driver.fail_write = DriverError("gone")
    with pytest.raises(DriverError):
        holding.advance(1)
    assert control(holding)["cause"] == Cause.EMERGENCY_STOP
    assert control(holding)["latest_cause"] == Cause.EXCEPTION


def test_cycle_failed_step_makes_passive(
    holding: Loop, driver: Faulty, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("in the step")

    monkeypatch.setattr(holding, "_decide", fail)
    kept = CycleArray(1)
    holding.publish = kept
    with pytest.raises(ZeroDivisionError) as raised:
        holding.run_tick(holding.clock.wait())
    assert "driver 'faulty'" in raised.value.__notes__[0]
    assert driver.passive == 1
    assert len(kept.cycles) == 0  # nothing was decided, so nothing is told


def test_cycle_keyboard_interrupt_makes_passive(holding: Loop, driver: Faulty) -> None:
    driver.fail_read = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        holding.advance(1)
    assert driver.applied == PASSIVE


def test_cycle_failed_publisher_lets_swing_complete(holding: Loop) -> None:
    calls = []

    def full(record: np.ndarray) -> None:
        calls.append(int(record["tick"][0]))
        raise OSError(28, "no space left")

    holding.publish = full
    holding.request(Request.SWING)
    for _ in range(1500):
        holding.run_tick(holding.clock.wait())
    assert len(calls) == 1
    assert isinstance(holding.publish_error, OSError)
    assert control(holding)["swings"] == 1
    assert control(holding)["cause"] == Cause.NONE


def test_cycle_array_copies_records_and_is_bounded() -> None:
    kept, record = CycleArray(2), new_record(CYCLE)
    for tick in (3, 4):
        record["tick"] = tick
        kept(record)
    assert kept.cycles["tick"].tolist() == [3, 4]
    with pytest.raises(IndexError):
        kept(record)


def test_bring_to_rest_tick_limit_makes_passive(holding: Loop, driver: Faulty) -> None:
    holding.advance(150, Request.SWING)
    records = bring_to_rest(holding, 15)
    assert sum(map(len, records)) == 15
    assert phase(holding) != Phase.STANDING
    assert driver.applied == PASSIVE


def test_cycle_replaced_state_and_parameters_apply_in_next_tick(holding: Loop) -> None:
    cycle = holding
    parameters = cycle.parameters._replace(control=cycle.parameters.control.copy())
    parameters.control["read_only"] = True
    cycle.state, cycle.parameters = new_control_state(State.FAULT), parameters
    cycle.request(Request.RESET)
    cycle.run_tick(holding.clock.wait())
    assert cycle.record["state"][0] == State.FAULT
    assert cycle.record["tick"][0] == 1
    assert cycle.record["refusal"][0] == Refusal.READ_ONLY


class Recording(Faulty):
    """A driver whose readings are a record."""

    def read(self, time: float) -> Readings:
        raise AssertionError("its readings are taken as a record")

    def read_record(self, time: float, record: np.ndarray) -> None:
        pack_readings(super().read(time), record)


class Guarded(Recording):
    """One that replaces `read` alone."""

    def read(self, time: float) -> Readings:
        raise DriverError("no frame")


def test_cycle_overridden_read_takes_precedence_over_read_record(parameters: ControlParameters) -> None:
    for kind, lost in ((Recording, False), (Guarded, True)):
        driver = kind()
        driver.open()
        cycle = Cycle(driver, parameters, CycleArray(1), name="recording")
        cycle.run_tick(0.0)
        assert (cycle.read_error is not None) is lost


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="asks for the compiled tick")
def test_cycle_ten_thousand_ticks_do_not_leak_memory(parameters: ControlParameters, tmp_path: Path) -> None:
    """From the readings of the simulated robot to the ring, with the collector off, as the loop runs."""
    driver = SimDriver(PLANT)
    driver.open()
    ring = RingWriter(tmp_path / "ring", 1024)
    loop = Cycle(driver, parameters, ring, name="sim")
    clock = FreeClock(PERIOD)

    def run(ticks: int) -> None:
        for tick in range(ticks):
            if tick % 1000 == 0:
                loop.request(Request.RESET)
            loop.run_tick(clock.wait())

    run(1)
    gc.collect()
    gc.disable()
    tracemalloc.start()
    try:
        run(3000)  # until the interpreter's stock of free tuples, at most 2,000 of each length, is full
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        run(10_000)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
        gc.enable()
        ring.close()
        driver.close()
    assert after - before < 1024, "objects that stay, or cycles that only the collector would free"
    assert peak - before < 16384, "what one tick needs at a time: two records and a few numbers"
