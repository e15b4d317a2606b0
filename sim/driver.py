"""The plant behind the driver contract: `read` advances it to the given time.

Time is counted in ticks of the plant, never accumulated and never read from a clock, so the same calls give
the same readings, bit for bit.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numba import carray
from numpy.typing import ArrayLike, NDArray

from drivers.base import PASSIVE, Command, DriverError, Readings, check_open, device_limited, invalid_time
from drivers.base.compiled import compiled_with_arrays, fields, new_record, numbers
from drivers.base.compiled_slots import newest_record, slots_at
from drivers.base.native import (
    DECLINED,
    DONE,
    OPERATIONAL,
    NativeCall,
    NativeCalls,
    compiled_call,
    copy_bytes,
    limit_command,
    pointer,
)
from drivers.base.records import COMMAND, READINGS, TRUTH, pack_command, unpack_command, unpack_readings
from drivers.base.shared_memory import SharedMemoryError
from sim.exchange import CONTACT, PLANT_REPORT, PLANT_SURROUNDINGS, HandledPlant, PlantFiles
from sim.faults import (
    Fault,
    Faults,
    break_parts,
    deliver_command,
    deliver_readings,
    new_faults,
    notice_onsets,
    own_records,
    revive,
)
from sim.impact import IMPACT
from sim.kane import bias_forces
from sim.kinematics import theta2_from_right_arm
from sim.plant import (
    PLANT_PARAMETERS,
    PLANT_STATE,
    Plant,
    PlantParameters,
    advance,
    build_plant,
    initial_state,
)
from sim.robot import ROBOT
from sim.sensors import Contact, contact_in, note_truth, sense

_NEAR = 1e-6
"""Rounding tolerance of a time, as a share of a tick."""

_PROGRESS = np.dtype([*fields("i8", "is_open has_begun ticks written"), *fields("f8", "period first offset")])
"""Progress of a SimDriver: `ticks` since the first reading after opening, which was at `first` (s of the
loop), and the tick of the last command; loop time minus plant time is `offset` (s)."""

_READINGS_SIZE, _COMMAND_SIZE = READINGS.itemsize, COMMAND.itemsize


def joint_travel(parameters: PlantParameters) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the min and max joint angles (3,) rad between the end stops."""
    robot = parameters.robot
    short, long = (
        float(theta2_from_right_arm(robot, robot.l56 + extension))
        for extension in (parameters.right_arm.lower, parameters.right_arm.upper)
    )
    return (
        np.array([parameters.shoulder.lower, min(short, long), parameters.wrist.lower]),
        np.array([parameters.shoulder.upper, max(short, long), parameters.wrist.upper]),
    )


def hanging_pose(parameters: PlantParameters) -> NDArray[np.float64]:
    """Return the joint angles (3,) rad of minimum potential energy within the end stops."""
    robot = parameters.robot
    lower, upper = joint_travel(parameters)
    angle: NDArray[np.float64] = (lower + upper) / 2
    for _ in range(400):  # steepest descent; the gradient is the gravity load
        angle = np.clip(angle - 0.02 * bias_forces(robot, angle, np.zeros(3)), lower, upper)
    return angle


class SimDriver:
    """Simulated bench: `read` advances the plant with the last command written.

    `plant_state` (PLANT_STATE) is public for tests.
    """

    def __init__(
        self,
        plant: Plant | PlantParameters | None = None,
        angle: ArrayLike | None = None,
        *,
        faults: tuple[Fault, ...] = (),
        watchdog: float = 0.02,
        seed: int = 1,
    ) -> None:
        """Start vented at joint angles `angle` (3,) rad, by default hanging.

        `faults` act between plant and bench, with the device's `watchdog` (s); their time counts from
        the first reading, their phases follow `phase`, which the caller sets before each tick.

        Raises:
            ValueError: `angle` is not three finite numbers, or a fault is invalid.
        """
        self.plant = plant if isinstance(plant, Plant) else build_plant(plant or PlantParameters())
        self.faults: Faults | None = None
        if faults:
            self.plant = own_records(self.plant)
            self.faults = new_faults(faults, self.plant, watchdog=watchdog, seed=seed)
        self.phase = -1
        """Phase of the bench, for faults with an onset by phase; -1 if unknown."""
        start = np.asarray(hanging_pose(self.plant.parameters) if angle is None else angle, dtype=float)
        if start.shape != (3,) or not np.all(np.isfinite(start)):
            raise ValueError(f"sim driver: start angles are {angle!r}, expected three finite numbers in rad")
        self.plant_state = initial_state(self.plant, start)
        self._readings, self._command = new_record(READINGS), new_record(COMMAND)
        pack_command(PASSIVE, self._command)
        self._progress = new_record(_PROGRESS)
        (
            self._is_open,
            self._has_begun,
            self._ticks,
            self._written,
            self._period,
            self._first,
            self._offset,
        ) = (numbers(self._progress[name]) for name in _PROGRESS.names or ())
        self._period[0] = self.plant.parameters.tick
        held = (*self.plant.records, self.plant_state, self._command, self._readings, self._progress)
        self._block = np.array([array.ctypes.data for array in held], np.int64)

    @property
    def applied(self) -> Command:
        """Command in force."""
        return unpack_command(self._command)

    def native_calls(self) -> NativeCalls:
        """Return the native functions; none with faults."""
        if self.faults is not None:
            return NativeCalls()
        functions = _read_native, _write_native, _note_truth_native
        return NativeCalls(*(NativeCall(one.address, self._block.ctypes.data) for one in functions))

    @property
    def operational(self) -> bool:
        """Whether the device follows commands; false only after a fault silenced the link too long."""
        return self.faults is None or not self.faults.device["passive"][0]

    def open(self) -> None:
        """Start with the passive command at the present plant state; DriverError if already open."""
        if self._is_open[0]:
            raise DriverError("sim driver: open() while already open; call close() first")
        self._apply(PASSIVE)
        self._has_begun[0] = self._ticks[0] = 0
        self._is_open[0] = True
        if self.faults is not None:
            revive(self.faults)

    def read(self, time: float) -> Readings:
        """Advance the plant to the last whole tick at or before `time` (s) and return its readings.

        Raises:
            DriverError: not open, or `time` is not finite or earlier than the last.
        """
        record = new_record(READINGS)
        self.read_record(time, record)
        return unpack_readings(record)

    def read_record(self, time: float, record: np.ndarray[Any, Any]) -> None:
        """Advance the plant as `read` does; write its readings into a READINGS record.

        Raises:
            DriverError: not open, or `time` is not finite or earlier than the last.
        """
        self._advance_to(time)
        record[...] = self._readings
        offset = self._offset[0]
        if offset != 0.0:
            record["time"] += offset
            record["encoder_time"] += offset

    def _advance_to(self, time: float) -> None:
        """Let `_readings` be those of the last whole tick at or before `time` (s)."""
        check_open(self._is_open[0], "sim", "read")
        if not self._has_begun[0] and math.isfinite(time):
            self._has_begun[0], self._first[0] = True, time
            self._offset[0] = time - float(self.plant_state["time"][0])
        first, period, ticks = self._first[0] if self._has_begun[0] else 0.0, self._period[0], self._ticks[0]
        part = (time - first) / period + _NEAR
        if not ticks <= part < math.inf:
            raise invalid_time(time, first + ticks * period, "sim")
        due = int(part)
        if self.faults is None:
            for _ in range(due - ticks):
                advance(*self.plant.records, self.plant_state, self._command)
            sense(self.plant.plant, self.plant_state, self._readings)
        else:
            self._read_faulty(self.faults, due)
        self._ticks[0] = due

    def _read_faulty(self, faults: Faults, due: int) -> None:
        """Advance the plant to tick `due` and read it, both with its faults."""
        robot, plant, _ = self.plant.records
        if due == 0:
            notice_onsets(faults, plant, self.plant_state, self.phase)
        for k in range(self._ticks[0], due):
            # Without a write in a tick, the bench was silent in it.
            deliver_command(faults, plant, self._command, k == self._written[0])
            break_parts(faults, robot, plant, self.plant_state)
            advance(*self.plant.records, self.plant_state, faults.sent)
            notice_onsets(faults, plant, self.plant_state, self.phase)
        deliver_readings(faults, plant, self.plant_state, self._readings)

    def write(self, command: Command) -> Command:
        """Apply `command` within the device's limits and return the applied one.

        Raises:
            DriverError: not open.
        """
        check_open(self._is_open[0], "sim", "write")
        return self._apply(device_limited(command))

    def make_passive(self) -> None:
        """Apply the passive command, in any state."""
        self._apply(PASSIVE)

    def close(self) -> None:
        """Make the device passive and close it, in any state."""
        self.make_passive()
        self._is_open[0] = False

    def place_ball(self) -> None:
        """Put a ball on the tee by hand."""
        self.plant_state["ball_present"], self.plant_state["struck"] = True, False

    @property
    def contact(self) -> Contact | None:
        """Contact with the last ball on the tee; None if it was not struck."""
        return contact_in(self.plant_state)

    def note_truth(self, cycle: np.ndarray[Any, Any]) -> None:
        """Write the fields `plant_*` of a CYCLE record (a one-element array)."""
        note_truth(self.plant_state, cycle)

    def _apply(self, command: Command) -> Command:
        self._written[0] = self._ticks[0]
        pack_command(command, self._command)
        return command


@compiled_with_arrays
def read_plant(block: int, record: int, time: float) -> int:
    """Advance the plant of a SimDriver's `block` as `read_record` does; the readings go to `record`."""
    a = carray(pointer(block), 7, np.int64)
    progress = carray(pointer(a[6]), 1, _PROGRESS)[0]
    if progress.is_open == 0 or progress.has_begun == 0:
        return DECLINED
    part = (time - progress.first) / progress.period + _NEAR
    if not progress.ticks <= part < np.inf:
        return DECLINED
    robot, plant = carray(pointer(a[0]), 1, ROBOT), carray(pointer(a[1]), 1, PLANT_PARAMETERS)
    impact, state = carray(pointer(a[2]), 1, IMPACT), carray(pointer(a[3]), 1, PLANT_STATE)
    due = int(part)
    for _ in range(due - progress.ticks):
        advance(robot, plant, impact, state, carray(pointer(a[4]), 1, COMMAND))
    sense(plant, state, carray(pointer(a[5]), 1, READINGS))
    progress.ticks = due
    copy_bytes(a[5], record, _READINGS_SIZE)
    if progress.offset != 0.0:
        out = carray(pointer(record), 1, READINGS)[0]
        out.time += progress.offset
        for i in range(3):
            out.encoder_time[i] += progress.offset
    return DONE | OPERATIONAL


@compiled_with_arrays
def write_plant(block: int, command: int, applied: int) -> int:
    """Apply the COMMAND at `command` within the device's limits, and write it to `applied`."""
    a = carray(pointer(block), 7, np.int64)
    progress = carray(pointer(a[6]), 1, _PROGRESS)[0]
    if progress.is_open == 0:
        return DECLINED
    limit_command(carray(pointer(command), 1, COMMAND), carray(pointer(applied), 1, COMMAND))
    copy_bytes(applied, a[4], _COMMAND_SIZE)
    progress.written = progress.ticks
    return DONE


@compiled_call
def _read_native(block: int, record: int, _: int, time: float) -> int:
    return read_plant(block, record, time)


@compiled_call
def _write_native(block: int, command: int, applied: int, time: float) -> int:
    return write_plant(block, command, applied)


@compiled_call
def _note_truth_native(block: int, truth: int, _: int, time: float) -> int:
    a = carray(pointer(block), 7, np.int64)
    note_truth(carray(pointer(a[3]), 1, PLANT_STATE), carray(pointer(truth), 1, TRUTH))
    return DONE


_FROZEN, _SURROUNDED, _STRUCK, _HAS_READ = range(4)
"""Memory of a PacedPlantDriver: whether readings are frozen, the version of the surroundings in force,
whether the ball was struck at the last check, and whether there are readings to freeze."""
_SIM, _SURROUNDINGS, _MEMORY, _LAST, _STATE = range(5)
"""Addresses in its block: SimDriver's block, that of the surroundings' file (0 while closed), its
memory, its last readings, and the plant's state."""


class PacedPlantDriver(SimDriver):
    """A plant paced by the loop, with controllable surroundings and contact reports in shared memory.

    The files are those of simulated nodes (`sim.exchange`), so simulated operators and launch monitors work
    with either. Only the contact is updated in the report.
    """

    def __init__(
        self, folder: Path, plant: PlantParameters, *, faults: tuple[Fault, ...] = (), watchdog: float = 0.02
    ) -> None:
        """Use `folder` of the bench for the files; `faults` as for `SimDriver`."""
        super().__init__(plant, faults=faults, watchdog=watchdog, seed=plant.seed)
        self._folder = folder
        self._files: PlantFiles | None = None
        self._surroundings, self._report = new_record(PLANT_SURROUNDINGS), new_record(PLANT_REPORT)
        self._handled = HandledPlant(self.plant, self.plant_state, self.faults)
        self._last = new_record(READINGS)
        self._struck = numbers(self.plant_state["struck"])
        remembered = np.zeros(4, np.int64)
        self._memory = numbers(remembered)
        held = self._block, remembered, self._last, self.plant_state
        self._paced_block = np.zeros(5, np.int64)
        self._paced_block[[_SIM, _MEMORY, _LAST, _STATE]] = [array.ctypes.data for array in held]

    def native_calls(self) -> NativeCalls:
        """Return the native functions; none with faults."""
        calls, block = super().native_calls(), self._paced_block.ctypes.data
        if not calls.read.function:
            return NativeCalls()
        read, write = NativeCall(_read_paced.address, block), NativeCall(_write_paced.address, block)
        return calls._replace(read=read, write=write)

    def open(self) -> None:
        """Create the files and start with the passive command.

        Raises:
            DriverError: already open, or the files cannot be created.
        """
        super().open()
        try:
            self._files = PlantFiles(self._folder)
        except SharedMemoryError as error:
            super().close()
            raise DriverError(f"sim driver: {error}") from error
        self._memory[_SURROUNDED] = 0
        self._paced_block[_SURROUNDINGS] = self._files.surroundings.slots.block.ctypes.data

    def read_record(self, time: float, record: np.ndarray[Any, Any]) -> None:
        """Advance the plant to `time` (s), report a struck ball, write the readings into `record`.

        Raises:
            DriverError: not open, or `time` is not finite or earlier than the last.
        """
        memory = self._memory
        if self._files is not None and self._files.surroundings.slots.head != memory[_SURROUNDED]:
            memory[_SURROUNDED] = self._files.surroundings.read(self._surroundings)
            self._handled.set_surroundings(self._surroundings)
            memory[_FROZEN] = self._handled.frozen
        super().read_record(time, record)
        self._note_contact()
        if memory[_FROZEN] and memory[_HAS_READ]:
            record[...] = self._last
            record["time"] = time
            record["encoder_age"] = time - record["encoder_time"]
        else:
            self._last[...] = record
            memory[_HAS_READ] = True

    def write(self, command: Command) -> Command:
        """Apply `command` within the device's limits; DriverError if not open."""
        self._note_contact()
        return super().write(command)

    def close(self) -> None:
        """Make the device passive, close it in any state, and remove the files."""
        super().close()
        self._paced_block[_SURROUNDINGS] = 0
        if self._files is not None:
            self._files.close()
            self._files = None

    def _note_contact(self) -> None:
        """Report a ball struck since the last check: its contact with the club, with loop time."""
        struck, report = self._struck[0], self._report
        if struck != self._memory[_STRUCK]:
            self._memory[_STRUCK] = struck
            if struck:
                for name in CONTACT.names or ():
                    report["contact"][name] = self.plant_state[name]
                report["contacts"] += 1
                if self._files is not None:
                    self._files.report.write(report)


@compiled_call
def _read_paced(block: int, record: int, _: int, time: float) -> int:
    """Read unless the surroundings have changed or readings are frozen."""
    a = carray(pointer(block), 5, np.int64)
    memory = carray(pointer(a[_MEMORY]), 4, np.int64)
    if a[_SURROUNDINGS] == 0 or memory[_FROZEN] != 0:
        return DECLINED
    if newest_record(slots_at(a[_SURROUNDINGS])) != memory[_SURROUNDED]:
        return DECLINED
    status = read_plant(a[_SIM], record, time)
    if status != DECLINED:
        copy_bytes(record, a[_LAST], _READINGS_SIZE)
        memory[_HAS_READ] = 1
    return status


@compiled_call
def _write_paced(block: int, command: int, applied: int, time: float) -> int:
    """Write unless a contact is to be reported."""
    a = carray(pointer(block), 5, np.int64)
    struck = carray(pointer(a[_STATE]), 1, PLANT_STATE)[0].struck
    if struck != (carray(pointer(a[_MEMORY]), 4, np.int64)[_STRUCK] != 0):
        return DECLINED
    return write_plant(a[_SIM], command, applied)
