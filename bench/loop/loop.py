"""The cycle: read, estimate, decide, limit, write, publish; a driver around it, compiled functions inside."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic_ns as now
from typing import Any, Protocol

import numpy as np
from numba import carray

from bench.base.clock import Clock
from bench.base.lifecycle import Cause, Phase, Request, State
from bench.control.states import latch_exception
from bench.control.step_records import ControlParameters, ControlState, new_control_state
from bench.loop._compiled_tick import AT_DECIDE, AT_NOTE_TRUTH, AT_READ, AT_WRITE, OVER, CompiledTick
from bench.records.telemetry.cycle_record import CYCLE, FIELDS
from drivers.base import ABSENT, PASSIVE, Command, Driver, DriverError, RecordReader
from drivers.base.compiled import new_record, numbers
from drivers.base.native import (
    DECLINED,
    DONE,
    NativeCall,
    NativeCalls,
    NativeDriver,
    compiled_call,
    copy_bytes,
    pointer,
)
from drivers.base.records import COMMAND, READINGS, pack_readings, unpack_command

Cycles = np.ndarray[Any, Any]
"""Records of CYCLE."""


_BETWEEN_LOOKS = 10
"""Ticks between two looks at the phase."""

_ROOM, _KEPT = 1, 2
_SIZE = CYCLE.itemsize

Publish = Callable[[Cycles], None]
"""Takes the record of one tick (a one-element array, overwritten in the next tick)."""


class Cycle:
    """One driver, one controller, one record; `run_tick` is everything that happens in a tick.

    Requests are put with `request`; `state` holds the answer. `read_error` and `publish_error` keep the
    first exception of their kind: neither ends a tick, both forbid to arm again. `marks` holds the instants
    (ns of CLOCK_MONOTONIC) of the last tick: begin, after read, estimate, decide, limit, write and publish.
    """

    def __init__(
        self,
        driver: Driver,
        parameters: ControlParameters,
        publish: Publish,
        *,
        name: str,
        note_truth: Publish | None = None,
        state: State = State.READY,
    ) -> None:
        """`name` is the driver's, for messages; `note_truth` records the true state of a simulated plant."""
        self.driver, self.name = driver, name
        self.marks = np.zeros(7, np.int64)
        self._marks = numbers(self.marks)
        self.record = new_record(CYCLE)
        self.read_error: Exception | None = None
        self.publish_error: Exception | None = None
        self._note_truth = note_truth
        self._readings, self._command = new_record(READINGS), new_record(COMMAND)
        self._read_record = record_reading(driver)
        self._calls = _native_calls(driver, note_truth)
        self._publisher = publish
        self._state, self._parameters = new_control_state(state), parameters
        self._bind()
        for field in FIELDS:
            if field.name.startswith("plant_"):
                self.record[field.name] = ABSENT

    @property
    def publish(self) -> Publish:
        """Publisher of the records; another one may be set between two ticks."""
        return self._publisher

    @publish.setter
    def publish(self, publish: Publish) -> None:
        self._publisher = publish
        self._bind_publisher()

    @property
    def state(self) -> ControlState:
        """Memory of the step; another one may be set between two ticks."""
        return self._state

    @state.setter
    def state(self, state: ControlState) -> None:
        self._state = state
        self._bind()

    @property
    def parameters(self) -> ControlParameters:
        """Parameters of the step; others may be set between two ticks."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: ControlParameters) -> None:
        self._parameters = parameters
        self._bind()

    def _bind(self) -> None:
        """Hand the records to the compiled part of the tick."""
        self._operational = numbers(self._state.control["device_operational"])
        self._run = self._decide = CompiledTick(
            self._state,
            self._parameters,
            self._readings,
            self._command,
            self.record,
            self.marks,
            self._calls,
            notes_truth=self._note_truth is not None,
        )
        self._bind_publisher()

    def _bind_publisher(self) -> None:
        """Hand the publisher to the compiled part, unless it has failed."""
        native: Callable[[], NativeCall] | None = getattr(self._publisher, "native_call", None)
        self._run.publish_by(native() if native and self.publish_error is None else NativeCall())

    def request(self, request: int) -> None:
        """Put a `Request` to the next tick."""
        self.state.control["request"] = request

    @property
    def phase(self) -> Phase:
        """Where in a swing the robot is."""
        return Phase(int(self.state.control["phase"][0]))

    def run_tick(self, time: float) -> None:
        """Do the tick at `time` (s).

        Readings that fail count as lost in this very tick. Whatever else fails makes the driver passive in
        this tick, latches Cause.EXCEPTION and is raised again with the driver's name.
        """
        marks, decided = self._marks, False
        try:
            stage = self._decide(time)
            if stage == OVER:
                return
            decided = stage != AT_READ
            if not decided:
                trusted = self._read(time)
                before = 0 if trusted else int(self.state.control["cause"][0])
                marks[1] = now()
                stage = self._decide(time, AT_DECIDE, OVER if trusted else AT_WRITE)
                decided = True
                if not trusted:
                    self._blame_exception(before)
            if stage == AT_WRITE:
                wanted = unpack_command(self._command)
                applied = self.driver.write(wanted)
                if applied != wanted:
                    self._note_applied(applied)
                stage = AT_NOTE_TRUTH
            if stage == AT_NOTE_TRUTH:
                if self._note_truth is not None:
                    self._note_truth(self.record)
                marks[5] = now()
        except BaseException as error:
            self.latch_exception(time, decided=decided)
            where = f"driver {self.name!r}, tick {int(self.state.control['tick'][0])}"
            if isinstance(error, DriverError):
                raise DriverError(f"{where}: {error}; the passive command was sent") from error
            error.add_note(f"{where}: the passive command was sent")
            raise
        if stage != OVER:
            self._publish()
            marks[6] = now()

    def _read(self, time: float) -> bool:
        """Take the readings at `time`; return False when that failed and nothing in them can be trusted."""
        try:
            self._read_record(time, self._readings)
            self._operational[0] = self.driver.operational
            return True
        except Exception as error:  # a driver may fail in any way
            self.read_error = self.read_error or error
        r = self._readings
        for name in ("emergency_stop_clear", "guard_closed", "guard_locked", "ball_present"):
            r[name] = False
        r["encoder_valid"] = r["encoder_indexed"] = 0
        r["encoder_age"] = r["supply_pressure"] = r["chamber_pressure"] = ABSENT
        r["vent_open"] = r["shut_off_open"] = r["spool_position"] = ABSENT
        # A driver that raises is no single lost sample: the stopping table is not to wait for more.
        self.state.estimator["without_sample"] = np.inf
        return False

    def _blame_exception(self, before: int) -> None:
        """Restore the cause `before` this tick, or set the exception: failed readings give none."""
        control = self.state.control
        if control["cause"][0] != before:
            control["cause"] = self.record["cause"] = before or Cause.EXCEPTION
            control["latest_cause"] = Cause.EXCEPTION

    def latch_exception(self, time: float, *, decided: bool = False) -> None:
        """Make the driver passive, latch the exception, and publish the tick if it was decided."""
        self.driver.make_passive()
        control = self.state.control
        latch_exception(control, self.parameters, time)
        if decided:
            for name in ("cause", "reaction", "state"):
                self.record[name] = control[name]
            self._note_applied(PASSIVE)
            self._publish()

    def _note_applied(self, applied: Command) -> None:
        """Write the command that the driver applied into the record."""
        self.record["applied_valve"] = applied.valve
        for name in ("supply_enable", "exhaust_closed", "guard_lock", "beacon", "tee"):
            self.record[name] = getattr(applied, name)

    def _publish(self) -> None:
        """Hand the record on; a publisher that fails lets the swing complete and is not called again."""
        if self.publish_error is None:
            try:
                self._publisher(self.record)
            except Exception as error:  # a publisher may fail in any way
                self.publish_error = error
                self._bind_publisher()


def record_reading(driver: Driver) -> Callable[[float, Any], None]:
    """Return what writes the readings of `driver` at a time (s) into a READINGS record.

    Its own `read_record`, unless it has none or `read` alone was replaced.
    """
    if isinstance(driver, RecordReader) and "read" not in getattr(driver, "__dict__", ()):
        first = next(kind for kind in type(driver).__mro__ if {"read", "read_record"} & vars(kind).keys())
        if "read_record" in vars(first):
            return driver.read_record
    return lambda time, record: pack_readings(driver.read(time), record)


def _native_calls(driver: Driver, note_truth: Publish | None) -> NativeCalls:
    """Return the driver's native functions; none where a method that they stand for was replaced."""
    if not isinstance(driver, NativeDriver):
        return NativeCalls()
    replaced = {"read", "read_record", "write", "operational", "native_calls"}
    kind = next(kind for kind in type(driver).__mro__ if replaced & vars(kind).keys())
    if "native_calls" not in vars(kind) or replaced & getattr(driver, "__dict__", {}).keys():
        return NativeCalls()
    calls = driver.native_calls()
    own = note_truth is not None and note_truth == getattr(driver, "note_truth", None)
    return calls if own else calls._replace(note_truth=NativeCall())


class CycleArray:
    """A publisher that keeps the records in memory, all of it allocated beforehand."""

    def __init__(self, capacity: int) -> None:
        self._cycles = np.zeros(capacity, CYCLE)
        self._bytes = self._cycles.view(np.uint8).reshape(capacity, CYCLE.itemsize)
        self._block = np.array([self._cycles.ctypes.data, capacity, 0], np.int64)
        """Address of the records, room for them, and how many are kept."""
        self._numbers = numbers(self._block)

    def __call__(self, record: Cycles) -> None:
        """Keep a copy of `record`; IndexError when there is no room left."""
        self._bytes[self._numbers[_KEPT]] = record.view(np.ndarray).view(np.uint8)
        self._numbers[_KEPT] += 1

    def native_call(self) -> NativeCall:
        """Return the native function that keeps a copy of the CYCLE at an address."""
        return NativeCall(_keep_native.address, self._block.ctypes.data)

    @property
    def cycles(self) -> Cycles:
        """The records kept so far."""
        return self._cycles[: self._numbers[_KEPT]]


@compiled_call
def _keep_native(block: int, record: int, _: int, time: float) -> int:
    a = carray(pointer(block), 3, np.int64)
    if a[_KEPT] >= a[_ROOM]:
        return DECLINED
    copy_bytes(record, a[0] + a[_KEPT] * _SIZE, _SIZE)
    a[_KEPT] += 1
    return DONE


class Stepper(Protocol):
    """What runs ticks: this module's `Loop`, or the compiled `bench.simulation.lockstep.Lockstep`."""

    state: ControlState
    parameters: ControlParameters

    @property
    def period(self) -> float:
        """Tick, s."""

    def advance(self, ticks: int, request: int = 0) -> Cycles:
        """Run `ticks` ticks with `request` in the first; return their records."""

    def make_passive(self) -> None:
        """Send the passive command, outside of any tick."""


class Loop(Cycle):
    """A cycle on a clock; `advance` keeps its records."""

    def __init__(
        self,
        driver: Driver,
        parameters: ControlParameters,
        clock: Clock,
        *,
        name: str,
        note_truth: Publish | None = None,
        state: State = State.READY,
    ) -> None:
        super().__init__(driver, parameters, lambda _: None, name=name, note_truth=note_truth, state=state)
        self.clock = clock

    @property
    def period(self) -> float:
        """Tick, s."""
        return self.clock.period

    def advance(self, ticks: int, request: int = 0) -> Cycles:
        """Run `ticks` ticks, `request` put at the first; return their records."""
        kept = CycleArray(ticks)
        self.publish = kept
        if request:
            self.request(request)
        for _ in range(ticks):
            self.run_tick(self.clock.wait())
        return kept.cycles

    def make_passive(self) -> None:
        """Send the passive command several times: a frame on a bus may be lost."""
        for _ in range(3):
            self.driver.make_passive()


def bring_to_rest(stepper: Stepper, longest: int) -> list[Cycles]:
    """Stop as the stopping table says, then send the passive command; return the records of that time.

    Takes at most `longest` ticks; joints that still move then get the passive command.
    """
    moves = stepper.state.control["phase"][0] != Phase.STANDING  # at rest a stop would latch
    records = [stepper.advance(1, Request.STOP if moves else 0)]
    left = longest - 1
    while left > 0 and stepper.state.control["phase"][0] != Phase.STANDING:
        records.append(stepper.advance(min(left, _BETWEEN_LOOKS)))
        left -= _BETWEEN_LOOKS
    stepper.make_passive()
    return records
