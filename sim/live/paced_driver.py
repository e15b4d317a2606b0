"""Driver of a plant paced by the loop, with controllable surroundings and reported contacts.

The files are those of simulated nodes (`sim.live.exchange`), so simulated operators and launch monitors work
with either. Only the contact is updated in the report.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numba import carray

from drivers.base import Command, DriverError, Readings
from drivers.base.compiled import new_record, numbers
from drivers.base.compiled_slots import newest_record, slots_at
from drivers.base.native import DECLINED, NativeCall, NativeCalls, compiled_call, copy_bytes, pointer
from drivers.base.records import READINGS, unpack_readings
from drivers.base.shared_memory import SharedMemoryError
from sim.driver import SimDriver, read_plant, write_plant
from sim.faults import Fault
from sim.live.exchange import CONTACT, PLANT_REPORT, PLANT_SURROUNDINGS, HandledPlant, PlantFiles
from sim.plant import PLANT_STATE, PlantParameters

_SIZE = READINGS.itemsize
_FROZEN, _SURROUNDED, _STRUCK, _HAS_READ = range(4)
"""Memory of a PacedPlantDriver: whether readings are frozen, the version of the surroundings in force,
whether the ball was struck at the last check, and whether there are readings to freeze."""
_SIM, _SURROUNDINGS, _MEMORY, _LAST, _STATE = range(5)
"""Addresses in its block: SimDriver's block, that of the surroundings' file (0 while closed), its
memory, its last readings, and the plant's state."""


class PacedPlantDriver:
    """A `sim.driver.SimDriver` with surroundings and contact reports in shared memory."""

    def __init__(
        self, folder: Path, plant: PlantParameters, *, faults: tuple[Fault, ...] = (), watchdog: float = 0.02
    ) -> None:
        """Use `folder` of the bench for the files; `faults` as for `SimDriver`."""
        self._folder = folder
        self._driver = SimDriver(plant, faults=faults, watchdog=watchdog, seed=plant.seed)
        self.note_truth = self._driver.note_truth
        self._files: PlantFiles | None = None
        self._surroundings, self._report = new_record(PLANT_SURROUNDINGS), new_record(PLANT_REPORT)
        self._handled = HandledPlant(self._driver.plant, self._driver.plant_state, self._driver.faults)
        self._readings, self._last = new_record(READINGS), new_record(READINGS)
        self._struck = numbers(self._driver.plant_state["struck"])
        self._remembered = np.zeros(4, np.int64)
        self._memory = numbers(self._remembered)
        self._calls = self._driver.native_calls()
        self._block = np.zeros(5, np.int64)
        self._block[_SIM] = self._calls.read.block
        held = self._remembered, self._last, self._driver.plant_state
        self._block[_MEMORY:] = [array.ctypes.data for array in held]

    @property
    def operational(self) -> bool:
        """Whether the device follows commands; false only after a fault silenced the link too long."""
        return self._driver.operational

    def set_phase(self, phase: int) -> None:
        """Set the bench's phase before a tick, for faults with an onset by phase."""
        self._driver.phase = phase

    def native_calls(self) -> NativeCalls:
        """Return the native functions; none with faults."""
        if not self._calls.read.function:
            return NativeCalls()
        block = self._block.ctypes.data
        return self._calls._replace(
            read=NativeCall(_read_native.address, block), write=NativeCall(_write_native.address, block)
        )

    def open(self) -> None:
        """Create the files and start with the passive command.

        Raises:
            DriverError: already open, or the files cannot be created.
        """
        self._driver.open()
        try:
            self._files = PlantFiles(self._folder)
        except SharedMemoryError as error:
            self._driver.close()
            raise DriverError(f"sim driver: {error}") from error
        self._memory[_SURROUNDED] = 0
        self._block[_SURROUNDINGS] = self._files.surroundings.slots.block.ctypes.data

    def read(self, time: float) -> Readings:
        """Advance the plant to `time` (s), report a struck ball, return the readings.

        Raises:
            DriverError: not open, or `time` is not finite or earlier than the last.
        """
        self.read_record(time, self._readings)
        return unpack_readings(self._readings)

    def read_record(self, time: float, record: np.ndarray[Any, Any]) -> None:
        """Advance the plant as `read` does; write its readings into a READINGS record.

        Raises:
            DriverError: not open, or `time` is not finite or earlier than the last.
        """
        memory = self._memory
        if self._files is not None and self._files.surroundings.slots.head != memory[_SURROUNDED]:
            memory[_SURROUNDED] = self._files.surroundings.read(self._surroundings)
            self._handled.set_surroundings(self._surroundings)
            memory[_FROZEN] = self._handled.frozen
        self._driver.read_record(time, record)
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
        return self._driver.write(command)

    def make_passive(self) -> None:
        """Apply the passive command, in any state."""
        self._driver.make_passive()

    def close(self) -> None:
        """Make the device passive, close it in any state, and remove the files."""
        self._driver.close()
        self._block[_SURROUNDINGS] = 0
        if self._files is not None:
            self._files.close()
            self._files = None

    def _note_contact(self) -> None:
        """Report a ball struck since the last check."""
        struck = self._struck[0]
        if struck != self._memory[_STRUCK]:
            self._memory[_STRUCK] = struck
            if struck:
                self._report_contact()

    def _report_contact(self) -> None:
        """Write the contact of club and ball, with loop time."""
        report: Any = self._report
        for name in CONTACT.names or ():
            report["contact"][name] = self._driver.plant_state[name]
        report["contacts"] += 1
        if self._files is not None:
            self._files.report.write(np.asarray(report))


@compiled_call
def _read_native(block: int, record: int, _: int, time: float) -> int:
    """Read unless the surroundings have changed or readings are frozen."""
    a = carray(pointer(block), 5, np.int64)
    memory = carray(pointer(a[_MEMORY]), 4, np.int64)
    if a[_SURROUNDINGS] == 0 or memory[_FROZEN] != 0:
        return DECLINED
    if newest_record(slots_at(a[_SURROUNDINGS])) != memory[_SURROUNDED]:
        return DECLINED
    status = read_plant(a[_SIM], record, time)
    if status != DECLINED:
        copy_bytes(record, a[_LAST], _SIZE)
        memory[_HAS_READ] = 1
    return status


@compiled_call
def _write_native(block: int, command: int, applied: int, time: float) -> int:
    """Write unless a contact is to be reported."""
    a = carray(pointer(block), 5, np.int64)
    struck = carray(pointer(a[_STATE]), 1, PLANT_STATE)[0].struck
    if struck != (carray(pointer(a[_MEMORY]), 4, np.int64)[_STRUCK] != 0):
        return DECLINED
    return write_plant(a[_SIM], command, applied)
