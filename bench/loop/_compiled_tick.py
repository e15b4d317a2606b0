"""The compiled part of a tick as one call, and the time of each stage.

Python needs several microseconds to hand a dozen records to a compiled function, and more after a sleep. So
one block of memory holds the records' addresses, and a call takes this block only. Where driver and publisher
have native functions (`drivers.base.native`), the call is the whole tick; where one of them has none, or
declines, the call returns at that stage, and the next call continues after it. The numerics are those of
`bench.control.step`, which lock-step simulation, sweeps and replay call: results are bit-identical.
"""

from __future__ import annotations

from time import monotonic_ns
from typing import Any

import numpy as np
from numba import carray

from bench.control.envelope import ENVELOPE_PARAMETERS
from bench.control.estimate.air import AIR_STATE
from bench.control.estimate.encoder import ENCODER_PARAMETERS, ENCODER_STATE
from bench.control.estimate.estimator import ESTIMATOR_PARAMETERS, ESTIMATOR_STATE
from bench.control.estimate.residual_monitor import MODEL_LIMITS, MODEL_STATE
from bench.control.law.gain_table import PID_PARAMETERS
from bench.control.law.pid import PID_STATE
from bench.control.step import decide_tick, estimate_tick, limit_tick
from bench.control.step_records import (
    CONTROL_PARAMETERS,
    CONTROL_STATE,
    PROFILE,
    ControlParameters,
    ControlState,
)
from bench.records.telemetry.cycle_record import CYCLE
from drivers.base.compiled import IS_PLAIN, compiled, compiled_with_arrays, new_record
from drivers.base.native import (
    DECLINED,
    OPERATIONAL,
    NativeCall,
    NativeCalls,
    call_native,
    monotonic_now,
    pointer,
)
from drivers.base.records import COMMAND, READINGS, TRUTH
from sim.plant import PLANT_PARAMETERS
from sim.robot import ROBOT

Array = np.ndarray[Any, Any]


AT_READ, AT_DECIDE, AT_WRITE, AT_NOTE_TRUTH, AT_PUBLISH, OVER = range(6)
"""Stages at which a tick starts or continues; AT_DECIDE covers estimate, decide and limit."""

_NUMBER = np.dtype(np.float64)
_TYPES: tuple[np.dtype[Any], ...] = (
    *(CONTROL_STATE, ENCODER_STATE, ESTIMATOR_STATE, PID_STATE, MODEL_STATE, AIR_STATE),
    *(CONTROL_PARAMETERS, ENCODER_PARAMETERS, ESTIMATOR_PARAMETERS, PID_PARAMETERS, ENVELOPE_PARAMETERS),
    *(MODEL_LIMITS, ROBOT, PLANT_PARAMETERS, PROFILE),
    *(_NUMBER, _NUMBER, _NUMBER, np.dtype(np.uint8), _NUMBER, _NUMBER, _NUMBER),
    *(READINGS, COMMAND, CYCLE, np.dtype(np.int64), COMMAND, TRUTH),
)
"""Types of the arrays behind the addresses: state, parameters, readings, command, record, marks, applied
command, truth."""
_COUNT = len(_TYPES)
_READINGS, _COMMAND, _RECORD, _MARKS, _APPLIED, _TRUTH = range(_COUNT - 6, _COUNT)
"""Indices of the arrays that are neither state nor parameters."""
_LENGTHS, _CALLS = _COUNT, 2 * _COUNT
"""Offsets in the block of the arrays' lengths and of the native calls."""
_READ, _WRITE, _NOTE_TRUTH, _PUBLISH = range(_CALLS, _CALLS + 8, 2)
"""Each is the address of a native function and of its memory; with address 0 Python does the step."""
_NOTHING = -1
"""Function of a stage that there is not."""
_CLOCK = _CALLS + 8
"""Offset of the kernel's time, 2 words."""
_BLOCK = _CLOCK + 2
"""Words of the block."""


def empty_parameters() -> ControlParameters:
    """Return empty parameters of the types that a tick takes, for compilation."""
    kinds = _TYPES[len(ControlState._fields) :][: len(ControlParameters._fields)]
    made = ControlParameters(*(new_record(kind) if kind.names else np.zeros((1, 3), kind) for kind in kinds))
    return made._replace(phase=np.zeros(1, np.uint8))


@compiled
def _take_truth(truth: Any, cycle: Any) -> None:
    """Copy a TRUTH record into the fields of the same names."""
    given, out = truth[0], cycle[0]
    for i in range(3):
        out.plant_angle[i], out.plant_velocity[i] = given.plant_angle[i], given.plant_velocity[i]
        out.plant_effort[i] = given.plant_effort[i]
    for i in range(6):
        out.plant_pressure[i] = given.plant_pressure[i]
    for i in range(2):
        out.plant_head_position[i] = given.plant_head_position[i]
    out.plant_head_speed = given.plant_head_speed


@compiled
def _note_applied(command: Any, applied: Any, cycle: Any) -> None:
    """Write the command that the driver applied into the record, if it differs from the one given."""
    wanted, done, out = command[0], applied[0], cycle[0]
    same = (
        wanted.supply_enable == done.supply_enable
        and wanted.exhaust_closed == done.exhaust_closed
        and wanted.guard_lock == done.guard_lock
        and wanted.beacon == done.beacon
        and wanted.tee == done.tee
        and wanted.search_index == done.search_index
    )
    for i in range(3):
        same = same and wanted.valve[i] == done.valve[i]
    if same:
        return
    for i in range(3):
        out.applied_valve[i] = done.valve[i]
    out.supply_enable, out.exhaust_closed, out.guard_lock = (
        done.supply_enable,
        done.exhaust_closed,
        done.guard_lock,
    )
    out.beacon, out.tee = done.beacon, done.tee


@compiled_with_arrays
def _run(address: int, time: float, stage: int, end: int) -> int:
    """Run the tick at `time` (s) from `stage` to before `end`; return the stage left to Python, or `end`.

    `address` is the memory address of the block, which holds the addresses of arrays and native functions.
    """
    a = carray(pointer(address), _BLOCK, np.int64)
    marks, clock = carray(pointer(a[_MARKS]), 7, np.int64), address + 8 * _CLOCK
    if stage == AT_READ:
        marks[0] = monotonic_now(clock)
        status = DECLINED
        if a[_READ] != 0:
            status = call_native(a[_READ], a[_READ + 1], a[_READINGS], 0, time)
        if status == DECLINED:
            return AT_READ
        carray(pointer(a[0]), 1, CONTROL_STATE)[0].device_operational = (status & OPERATIONAL) != 0
        marks[1] = monotonic_now(clock)
        stage = AT_DECIDE
    if stage == AT_DECIDE:
        _think(a, marks, clock, time)
        stage = AT_WRITE
    if stage == AT_WRITE and end > AT_WRITE and a[_WRITE] != 0:
        if call_native(a[_WRITE], a[_WRITE + 1], a[_COMMAND], a[_APPLIED], time) != DECLINED:
            applied, cycle = carray(pointer(a[_APPLIED]), 1, COMMAND), carray(pointer(a[_RECORD]), 1, CYCLE)
            _note_applied(carray(pointer(a[_COMMAND]), 1, COMMAND), applied, cycle)
            stage = AT_NOTE_TRUTH
    if stage == AT_NOTE_TRUTH and end > AT_NOTE_TRUTH and a[_NOTE_TRUTH] != 0:
        if a[_NOTE_TRUTH] == _NOTHING:
            stage = AT_PUBLISH
        elif call_native(a[_NOTE_TRUTH], a[_NOTE_TRUTH + 1], a[_TRUTH], 0, time) != DECLINED:
            _take_truth(carray(pointer(a[_TRUTH]), 1, TRUTH), carray(pointer(a[_RECORD]), 1, CYCLE))
            stage = AT_PUBLISH
        if stage == AT_PUBLISH:
            marks[5] = monotonic_now(clock)
    if stage == AT_PUBLISH and end > AT_PUBLISH and a[_PUBLISH] != 0:
        if call_native(a[_PUBLISH], a[_PUBLISH + 1], a[_RECORD], 0, time) != DECLINED:
            marks[6] = monotonic_now(clock)
            stage = OVER
    return stage


@compiled_with_arrays
def _think(a: Any, marks: Any, clock: int, time: float) -> None:
    """Estimate, decide and limit on the records at the addresses in the block `a`."""
    n = a[_LENGTHS : _LENGTHS + _COUNT]
    state = ControlState(
        carray(pointer(a[0]), 1, CONTROL_STATE),
        carray(pointer(a[1]), 1, ENCODER_STATE),
        carray(pointer(a[2]), 1, ESTIMATOR_STATE),
        carray(pointer(a[3]), 1, PID_STATE),
        carray(pointer(a[4]), 1, MODEL_STATE),
        carray(pointer(a[5]), 1, AIR_STATE),
    )
    parameters = ControlParameters(
        carray(pointer(a[6]), 1, CONTROL_PARAMETERS),
        carray(pointer(a[7]), 1, ENCODER_PARAMETERS),
        carray(pointer(a[8]), 1, ESTIMATOR_PARAMETERS),
        carray(pointer(a[9]), 1, PID_PARAMETERS),
        carray(pointer(a[10]), 1, ENVELOPE_PARAMETERS),
        carray(pointer(a[11]), 1, MODEL_LIMITS),
        carray(pointer(a[12]), 1, ROBOT),
        carray(pointer(a[13]), 1, PLANT_PARAMETERS),
        carray(pointer(a[14]), 1, PROFILE),
        carray(pointer(a[15]), (n[15], 3), np.float64),
        carray(pointer(a[16]), (n[16], 3), np.float64),
        carray(pointer(a[17]), (n[17], 3), np.float64),
        carray(pointer(a[18]), n[18], np.uint8),
        carray(pointer(a[19]), (n[19], 3), np.float64),
        carray(pointer(a[20]), (n[20], 3), np.float64),
        carray(pointer(a[21]), (n[21], 6), np.float64),
    )
    readings, command = carray(pointer(a[_READINGS]), 1, READINGS), carray(pointer(a[_COMMAND]), 1, COMMAND)
    estimate_tick(state, parameters, readings, time)
    marks[2] = monotonic_now(clock)
    decide_tick(state, parameters, readings, time)
    marks[3] = monotonic_now(clock)
    limit_tick(state, parameters, readings, command, carray(pointer(a[_RECORD]), 1, CYCLE))
    marks[4] = monotonic_now(clock)


class CompiledTick:
    """Runs ticks on the given records; holds references to them, as it uses their addresses."""

    def __init__(
        self,
        state: ControlState,
        parameters: ControlParameters,
        readings: Array,
        command: Array,
        cycle: Array,
        marks: Array,
        calls: NativeCalls | None = None,
        *,
        notes_truth: bool = False,
    ) -> None:
        """`marks` (7,) ns gets the instants of `bench.loop.loop.Cycle` that the call passes.

        `calls` are the driver's native functions; `notes_truth`: the true state of a simulated plant is
        recorded, by a native function or in Python.

        Raises:
            ValueError: an array has the wrong type or size, or is not contiguous.
        """
        applied, truth = new_record(COMMAND), new_record(TRUTH)
        arrays = (*state, *parameters, readings, command, cycle, marks, applied, truth)
        for array, expected in zip(arrays, _TYPES, strict=True):
            if array.dtype != expected or not array.flags.c_contiguous:
                raise ValueError(f"a tick's array of {array.dtype}, expected {expected}, contiguous")
            if expected.names and len(array) != 1:
                raise ValueError(f"a tick's array of {len(array)} records, expected one record")
        self._state, self._parameters, self._marks = state, parameters, marks
        self._readings, self._command, self._cycle = readings, command, cycle
        self._own = applied, truth
        self._block = np.zeros(_BLOCK, np.int64)
        self._block[:_COUNT] = [array.ctypes.data for array in arrays]
        self._block[_LENGTHS:_CALLS] = [len(array) for array in arrays]
        native = calls or NativeCalls()
        self._block[_READ:_PUBLISH] = [*native.read, *native.write, *native.note_truth]
        if not notes_truth:
            self._block[_NOTE_TRUTH] = _NOTHING
        self._address = self._block.ctypes.data

    def publish_by(self, call: NativeCall) -> None:
        """Publish by the native function `call` from now on."""
        self._block[_PUBLISH : _PUBLISH + 2] = call

    def __call__(self, time: float, stage: int = AT_READ, end: int = OVER) -> int:
        """Run the tick at `time` (s) from `stage` to before `end`, as far as it goes without Python.

        Return the stage that it has come to: the first that is Python's to do, or `end`.
        """
        if IS_PLAIN:
            return self._run_plain(time, stage)
        return _run(self._address, time, stage, end)

    def _run_plain(self, time: float, stage: int) -> int:
        state, parameters, marks = self._state, self._parameters, self._marks
        if stage == AT_READ:
            marks[0] = monotonic_ns()
        if stage != AT_DECIDE:
            return stage
        estimate_tick(state, parameters, self._readings, time)
        marks[2] = monotonic_ns()
        decide_tick(state, parameters, self._readings, time)
        marks[3] = monotonic_ns()
        limit_tick(state, parameters, self._readings, self._command, self._cycle)
        marks[4] = monotonic_ns()
        return AT_WRITE
