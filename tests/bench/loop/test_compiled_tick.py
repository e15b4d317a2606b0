"""One call a tick gives the bits of the functions it stands for, on the records it was made with."""

from __future__ import annotations

from time import monotonic_ns
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Request, State
from bench.control.settings import build_controller
from bench.control.step import step
from bench.control.step_records import ControlParameters, ControlState, new_control_state
from bench.loop._compiled_tick import AT_DECIDE, AT_WRITE, CompiledTick
from bench.records.telemetry.cycle_record import CYCLE
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.compiled import new_record
from drivers.base.records import COMMAND, READINGS
from sim.driver import SimDriver
from sim.plant import PlantParameters


@pytest.fixture(scope="module")
def parameters() -> ControlParameters:
    return build_controller(PlantParameters(), load_profile(find_profile("default")))


class Records:
    """All that a tick works on."""

    def __init__(self) -> None:
        self.state = new_control_state(State.READY)
        self.readings, self.command, self.cycle = new_record(READINGS), new_record(COMMAND), new_record(CYCLE)
        self.marks = np.zeros(7, np.int64)

    def tick(self, parameters: ControlParameters) -> CompiledTick:
        return CompiledTick(self.state, parameters, self.readings, self.command, self.cycle, self.marks)

    def bits(self) -> list[bytes]:
        return [array.tobytes() for array in (*self.state, self.command, self.cycle)]


def read_into(records: Records, driver: SimDriver, tick: int) -> None:
    if tick == 20:
        records.state.control["request"] = Request.ARM
    driver.read_record(1e-3 * tick, records.readings)


def test_compiled_tick_matches_step_bit_for_bit(parameters: ControlParameters) -> None:
    one, other, driver, twin = Records(), Records(), SimDriver(), SimDriver()
    driver.open()
    twin.open()
    tick = one.tick(parameters)
    for k in range(400):
        read_into(one, driver, k)
        read_into(other, twin, k)
        tick(1e-3 * k, AT_DECIDE)
        step(other.state, parameters, other.readings, 1e-3 * k, other.command, other.cycle)
        assert one.bits() == other.bits(), k
    assert one.cycle["state"][0] == State.ARMED


def test_compiled_tick_marks_use_monotonic_clock(parameters: ControlParameters) -> None:
    records = Records()
    tick = records.tick(parameters)
    tick(0.0, AT_DECIDE)
    begin = monotonic_ns()
    assert tick(1e-3, AT_DECIDE) == AT_WRITE
    end = monotonic_ns()
    marks = records.marks.tolist()
    assert begin <= marks[2] <= marks[3] <= marks[4] <= end
    assert marks[:2] == marks[5:] == [0, 0]


@pytest.mark.parametrize("wrong", ["type", "order"])
def test_compiled_tick_wrong_array_type_or_order_is_refused(
    parameters: ControlParameters, wrong: str
) -> None:
    table: Any = parameters.angle
    table = table.astype(np.float32) if wrong == "type" else np.asfortranarray(table)
    with pytest.raises(ValueError, match="contiguous"):
        Records().tick(parameters._replace(angle=table))


def test_compiled_tick_state_of_two_records_is_refused(parameters: ControlParameters) -> None:
    records = Records()
    state = ControlState(*(np.concatenate([array, array]) for array in records.state))
    with pytest.raises(ValueError, match="one record"):
        CompiledTick(state, parameters, records.readings, records.command, records.cycle, records.marks)
