"""A tick that is one call into compiled code has the bits of a tick in Python, and leaves it the rest."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.base.lifecycle import Cause, Request
from bench.control.settings import build_controller
from bench.control.step_records import ControlParameters
from bench.loop._compiled_tick import AT_READ, OVER
from bench.loop.loop import Cycle, CycleArray
from bench.records.telemetry.ring import RingReader, RingWriter
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base import Command, DriverError, device_limited
from drivers.base.compiled import new_record
from drivers.base.native import NativeCalls, limit_command
from drivers.base.records import COMMAND, pack_command, unpack_command
from drivers.base.shared_memory import SharedRecord
from sim.driver import PacedPlantDriver, SimDriver
from sim.exchange import PLANT_REPORT, PLANT_SURROUNDINGS, REPORT_FILE, SURROUNDINGS_FILE
from sim.faults import Fault
from sim.plant import PlantParameters

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")

PERIOD = PlantParameters().tick


class PlainSim(SimDriver):
    def native_calls(self) -> NativeCalls:
        return NativeCalls()


class PlainPaced(PacedPlantDriver):
    def native_calls(self) -> NativeCalls:
        return NativeCalls()


@pytest.fixture(scope="module")
def parameters() -> ControlParameters:
    return build_controller(PlantParameters(), load_profile(find_profile("default")))


class Bench:
    """A cycle that keeps its records, and its calls."""

    def __init__(self, driver: Any, parameters: ControlParameters, room: int = 4000) -> None:
        self.driver, self.kept = driver, CycleArray(room)
        self.cycle = Cycle(driver, parameters, self.kept, name="sim", note_truth=driver.note_truth)
        self.decide = self.cycle._decide
        self.calls: list[int] = []
        """Stage at which each call into compiled code ended."""
        self.cycle._decide = self._called  # type: ignore[assignment]

    def _called(self, *arguments: Any) -> int:
        self.calls.append(self.decide(*arguments))
        return self.calls[-1]

    def run(self, begin: int, end: int, offset: float = 0.0) -> None:
        for k in range(begin, end):
            self.cycle.run_tick(offset + k * PERIOD)


def assert_same(one: Bench, other: Bench) -> None:
    assert one.kept.cycles.tobytes() == other.kept.cycles.tobytes()
    for ours, theirs in zip(one.cycle.state, other.cycle.state, strict=True):
        assert ours.tobytes() == theirs.tobytes()
    assert getattr(one.driver, "applied", None) == getattr(other.driver, "applied", None)


def test_native_tick_is_single_call_and_matches_python_bits(parameters: ControlParameters) -> None:
    benches = [Bench(kind(), parameters) for kind in (SimDriver, PlainSim)]
    for bench in benches:
        bench.driver.open()
        bench.run(0, 20, 5.0)
        bench.cycle.request(Request.ARM)
        bench.run(20, 2500, 5.0)
        bench.cycle.request(Request.SWING)
        bench.run(2500, 4000, 5.0)
    one, other = benches
    assert_same(one, other)
    assert one.driver.plant_state.tobytes() == other.driver.plant_state.tobytes()
    assert one.calls[0] == AT_READ  # the first reading sets the clock
    assert set(one.calls[2:]) == {OVER}
    assert np.isfinite(one.kept.cycles["plant_angle"]).all()
    assert np.all(np.diff(one.cycle.marks) >= 0)


def test_sim_driver_with_faults_has_no_native_calls(parameters: ControlParameters) -> None:
    driver = SimDriver(faults=(Fault("blind", "ball sensor", "off"),))
    assert driver.native_calls() == NativeCalls()


@pytest.mark.parametrize("replaced", ["read", "read_record", "write"])
def test_native_tick_overridden_driver_method_is_called(parameters: ControlParameters, replaced: str) -> None:
    called = []

    def note(self: SimDriver, *arguments: Any) -> Any:
        called.append(replaced)
        return getattr(SimDriver, replaced)(self, *arguments)

    driver = type("Replaced", (SimDriver,), {replaced: note})()
    driver.open()
    Bench(driver, parameters).run(0, 3)
    assert len(called) >= 3


def test_native_tick_closed_driver_and_nan_time_raise_driver_error(parameters: ControlParameters) -> None:
    bench = Bench(SimDriver(), parameters)
    bench.driver.open()
    bench.run(0, 10)
    bench.cycle.run_tick(math.nan)  # readings that fail
    assert isinstance(bench.cycle.read_error, DriverError)
    assert bench.kept.cycles["cause"][-1] == Cause.EXCEPTION
    bench.driver.close()
    with pytest.raises(DriverError, match="write"):
        bench.cycle.run_tick(11 * PERIOD)


def test_native_tick_full_publisher_sets_publish_error(parameters: ControlParameters) -> None:
    bench = Bench(SimDriver(), parameters, room=5)
    bench.driver.open()
    bench.run(0, 8)
    assert isinstance(bench.cycle.publish_error, IndexError)
    assert bench.kept.cycles["tick"].tolist() == [1, 2, 3, 4, 5]
    bench.cycle.publish = later = CycleArray(5)
    bench.run(8, 9)
    assert len(later.cycles) == 0  # a publisher that failed is not asked again


def test_native_tick_ring_receives_every_record(parameters: ControlParameters, tmp_path: Path) -> None:
    bench = Bench(SimDriver(), parameters)
    ring = RingWriter(tmp_path / "ring", 64)
    bench.cycle.publish = ring
    bench.driver.open()
    reader = RingReader(tmp_path / "ring", from_oldest=True)
    bench.run(0, 50)
    assert bench.calls[-1] == OVER
    found = reader.read()
    assert found["tick"].tolist() == list(range(1, 51))
    assert found[-1].tobytes() == bench.cycle.record[0].tobytes()
    ring.close()
    bench.run(50, 51)
    assert isinstance(bench.cycle.publish_error, ValueError)
    reader.close()


def test_native_tick_paced_plant_matches_python_bits(parameters: ControlParameters, tmp_path: Path) -> None:
    found = []
    benches = []
    for kind in (PacedPlantDriver, PlainPaced):
        folder = tmp_path / kind.__name__
        folder.mkdir()
        bench = Bench(kind(folder, PlantParameters()), parameters)
        bench.driver.open()
        bench.run(0, 10)
        outside = SharedRecord.open(folder / SURROUNDINGS_FILE, PLANT_SURROUNDINGS)
        around = np.zeros(1, PLANT_SURROUNDINGS)
        around["emergency_stop_clear"] = around["guard_closed"] = True
        around["encoder_valid"] = 1
        around["ball_handled"] = around["ball_present"] = 1
        outside.write(around)
        bench.run(10, 20)
        around["frozen"] = True
        outside.write(around)
        bench.run(20, 25)
        around["frozen"] = False
        outside.write(around)
        bench.run(25, 30)
        bench.driver.plant_state["struck"] = True
        bench.run(30, 35)
        report, shared = np.zeros(1, PLANT_REPORT), SharedRecord.open(folder / REPORT_FILE, PLANT_REPORT)
        assert shared.read(report) == 1
        found.append(report.tobytes())
        outside.close()
        shared.close()
        benches.append(bench)
        bench.driver.close()
    assert_same(*benches)
    assert found[0] == found[1]
    assert benches[0].calls[-1] == OVER


finite_or_not = st.floats(allow_nan=True, allow_infinity=True)


@settings(max_examples=100, deadline=None)
@given(valve=st.tuples(*[finite_or_not | st.floats(-1.5, 1.5)] * 3), bits=st.tuples(*[st.booleans()] * 6))
def test_limit_command_matches_device_limited(
    valve: tuple[float, float, float], bits: tuple[bool, ...]
) -> None:
    command = Command(valve, *bits)
    given_, applied, expected = (new_record(COMMAND) for _ in range(3))
    pack_command(command, given_)
    limit_command(given_, applied)
    pack_command(device_limited(command), expected)
    assert applied.tobytes() == expected.tobytes(), (unpack_command(applied), device_limited(command))
