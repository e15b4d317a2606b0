"""The compiled part of a tick as one call: estimate, decide and limit, and the time of each.

Python needs several microseconds to hand a dozen records to a compiled function, and more after a sleep. So a
vector holds the records' addresses, and a call takes this vector only. The functions are those of
`bench.control.step`, which lock-step simulation, sweeps and replay call: the same bits.
"""

from __future__ import annotations

from time import monotonic_ns
from typing import Any

import numba
import numpy as np
from numba import carray, types
from numba.extending import intrinsic

from bench.control.air import AIR_STATE
from bench.control.encoder import ENCODER_PARAMETERS, ENCODER_STATE
from bench.control.envelope import ENVELOPE_PARAMETERS
from bench.control.estimator import ESTIMATOR_PARAMETERS, ESTIMATOR_STATE
from bench.control.model import MODEL_LIMITS, MODEL_STATE
from bench.control.pid import PID_PARAMETERS, PID_STATE
from bench.control.records import (
    CONTROL_PARAMETERS,
    CONTROL_STATE,
    PROFILE,
    ControlParameters,
    ControlState,
)
from bench.control.step import decide_tick, estimate_tick, limit_tick
from bench.telemetry.cycle_record import CYCLE
from drivers.base import COMMAND, READINGS
from drivers.base.compiled import compiled
from sim.plant import PLANT_PARAMETERS
from sim.robot import ROBOT

Array = np.ndarray[Any, Any]

_NUMBER = np.dtype(np.float64)
_TYPES: tuple[np.dtype[Any], ...] = (
    *(CONTROL_STATE, ENCODER_STATE, ESTIMATOR_STATE, PID_STATE, MODEL_STATE, AIR_STATE),
    *(CONTROL_PARAMETERS, ENCODER_PARAMETERS, ESTIMATOR_PARAMETERS, PID_PARAMETERS, ENVELOPE_PARAMETERS),
    *(MODEL_LIMITS, ROBOT, PLANT_PARAMETERS, PROFILE),
    *(_NUMBER, _NUMBER, _NUMBER, np.dtype(np.uint8), _NUMBER, _NUMBER, _NUMBER),
    *(READINGS, COMMAND, CYCLE, np.dtype(np.int64)),
)
"""Types of the arrays behind the addresses: state, parameters, readings, command, record, marks."""
_CLOCK_MONOTONIC = 1
_SECOND = 1_000_000_000

_clock_gettime = types.ExternalFunction("clock_gettime", types.intc(types.intc, types.intp))


@intrinsic  # type: ignore[untyped-decorator]
def _pointer(typing: Any, address: Any) -> Any:
    """Return the address as a pointer."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.intp), generate


@compiled
def _now(a: Any) -> int:
    """Return CLOCK_MONOTONIC in ns; the kernel writes it behind the vector's last address."""
    _clock_gettime(_CLOCK_MONOTONIC, a[len(a) - 1])
    t = carray(_pointer(a[len(a) - 1]), 2, np.int64)
    return t[0] * _SECOND + t[1]  # type: ignore[no-any-return]


@compiled
def _run(a: Any, n: Any, time: float) -> None:
    """Run the tick at `time` (s) on the records at the addresses `a` of the lengths `n`."""
    state = ControlState(
        carray(_pointer(a[0]), 1, CONTROL_STATE),
        carray(_pointer(a[1]), 1, ENCODER_STATE),
        carray(_pointer(a[2]), 1, ESTIMATOR_STATE),
        carray(_pointer(a[3]), 1, PID_STATE),
        carray(_pointer(a[4]), 1, MODEL_STATE),
        carray(_pointer(a[5]), 1, AIR_STATE),
    )
    parameters = ControlParameters(
        carray(_pointer(a[6]), 1, CONTROL_PARAMETERS),
        carray(_pointer(a[7]), 1, ENCODER_PARAMETERS),
        carray(_pointer(a[8]), 1, ESTIMATOR_PARAMETERS),
        carray(_pointer(a[9]), 1, PID_PARAMETERS),
        carray(_pointer(a[10]), 1, ENVELOPE_PARAMETERS),
        carray(_pointer(a[11]), 1, MODEL_LIMITS),
        carray(_pointer(a[12]), 1, ROBOT),
        carray(_pointer(a[13]), 1, PLANT_PARAMETERS),
        carray(_pointer(a[14]), 1, PROFILE),
        carray(_pointer(a[15]), (n[15], 3), np.float64),
        carray(_pointer(a[16]), (n[16], 3), np.float64),
        carray(_pointer(a[17]), (n[17], 3), np.float64),
        carray(_pointer(a[18]), n[18], np.uint8),
        carray(_pointer(a[19]), (n[19], 3), np.float64),
        carray(_pointer(a[20]), (n[20], 3), np.float64),
        carray(_pointer(a[21]), (n[21], 6), np.float64),
    )
    readings, command = carray(_pointer(a[22]), 1, READINGS), carray(_pointer(a[23]), 1, COMMAND)
    cycle, marks = carray(_pointer(a[24]), 1, CYCLE), carray(_pointer(a[25]), n[25], np.int64)
    estimate_tick(state, parameters, readings, time)
    marks[2] = _now(a)
    decide_tick(state, parameters, readings, time)
    marks[3] = _now(a)
    limit_tick(state, parameters, readings, command, cycle)
    marks[4] = _now(a)


class CompiledTick:
    """Runs ticks on the records it was made with; holds them, as it knows their addresses."""

    def __init__(
        self,
        state: ControlState,
        parameters: ControlParameters,
        readings: Array,
        command: Array,
        cycle: Array,
        marks: Array,
    ) -> None:
        """`marks` (7,) ns gets the instants after estimate, decide and limit, at 2, 3 and 4.

        Raises:
            ValueError: an array is of another type or number, or not contiguous.
        """
        arrays = (*state, *parameters, readings, command, cycle, marks)
        for array, expected in zip(arrays, _TYPES, strict=True):
            if array.dtype != expected or not array.flags.c_contiguous:
                raise ValueError(f"a tick's array of {array.dtype}, expected {expected}, contiguous")
            if expected.names and len(array) != 1:
                raise ValueError(f"a tick's array of {len(array)} records, expected one record")
        self._state, self._parameters, self._marks = state, parameters, marks
        self._readings, self._command, self._cycle = readings, command, cycle
        self._clock = np.zeros(2, np.int64)
        self._addresses = np.array([array.ctypes.data for array in (*arrays, self._clock)], np.int64)
        self._lengths = np.array([len(array) for array in arrays], np.int64)

    def __call__(self, time: float) -> None:
        """Run the tick at `time` (s): readings in, command and record out."""
        if numba.config.DISABLE_JIT:
            self._run_plain(time)
        else:
            _run(self._addresses, self._lengths, time)

    def _run_plain(self, time: float) -> None:
        state, parameters, marks = self._state, self._parameters, self._marks
        estimate_tick(state, parameters, self._readings, time)
        marks[2] = monotonic_ns()
        decide_tick(state, parameters, self._readings, time)
        marks[3] = monotonic_ns()
        limit_tick(state, parameters, self._readings, self._command, self._cycle)
        marks[4] = monotonic_ns()
