"""Driver of a plant paced by the loop, with controllable surroundings and reported contacts.

The files are those of a plant process (`sim.live.exchange`), so that operator and launch monitor simulations
work with both. Only the contact is updated in the report.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import READINGS, Command, DriverError, Readings, unpack_readings
from drivers.base.compiled import new_record
from drivers.base.shared_record import SharedMemoryError
from sim.driver import SimDriver
from sim.faults import Fault
from sim.live.exchange import CONTACT, PLANT_REPORT, PLANT_SURROUNDINGS
from sim.live.handled_plant import HandledPlant
from sim.live.process import PlantFiles
from sim.plant import PlantParameters


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
        self._surrounded, self._was_struck = 0, False
        self._handled = HandledPlant(self._driver.plant, self._driver.plant_state)
        self._readings, self._last = new_record(READINGS), new_record(READINGS)
        self._has_read = False
        self._struck = self._driver.plant_state["struck"]

    @property
    def operational(self) -> bool:
        """Whether the device follows commands; false only after a fault silenced the link too long."""
        return self._driver.operational

    def set_phase(self, phase: int) -> None:
        """Set the bench's phase before a tick, for faults with an onset by phase."""
        self._driver.phase = phase

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
        self._surrounded = 0

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
        if self._files is not None and self._files.surroundings.newest != self._surrounded:
            self._surrounded = self._files.surroundings.read(self._surroundings)
            self._handled.set_surroundings(self._surroundings)
        self._driver.read_record(time, record)
        if (struck := bool(self._struck[0])) != self._was_struck:
            self._was_struck = struck
            if struck:
                self._report_contact()
        if self._handled.frozen and self._has_read:
            record[...] = self._last
            record["time"] = time
            record["encoder_age"] = time - record["encoder_time"]
        else:
            self._last[...] = record
            self._has_read = True

    def write(self, command: Command) -> Command:
        """Apply `command` within the device's limits; DriverError if not open."""
        return self._driver.write(command)

    def make_passive(self) -> None:
        """Apply the passive command, in any state."""
        self._driver.make_passive()

    def close(self) -> None:
        """Make the device passive, close it in any state, and remove the files."""
        self._driver.close()
        if self._files is not None:
            self._files.close()
            self._files = None

    def _report_contact(self) -> None:
        """Write the contact of club and ball, with loop time."""
        report: Any = self._report
        for name in CONTACT.names or ():
            report["contact"][name] = self._driver.plant_state[name]
        report["contacts"] += 1
        if self._files is not None:
            self._files.report.write(np.asarray(report))
