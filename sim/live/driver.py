"""Driver of the plant in its own process: a bench whose valves keep running when the loop stops.

Each call copies from or to shared memory without blocking. Times are CLOCK_MONOTONIC (s).
"""

from __future__ import annotations

import math
import time as wall
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import (
    PASSIVE,
    READINGS,
    Command,
    DriverError,
    Readings,
    device_limited,
    unpack_readings,
)
from drivers.base.compiled import compiled, new_record
from drivers.base.shared_record import SharedMemoryError, SharedRecord
from sim.live.exchange import COMMAND_FILE, PLANT_COMMAND, PLANT_REPORT, REPORT_FILE
from sim.live.valve_watchdog import Mode
from sim.truth import Contact, contact_in

_NEAR = 1e-9
_POLL_PERIOD = 0.0005
_COUNTERS = 2**62 - 1
"""Mask that keeps a counter from overflowing when it continues from garbage."""


class ProcessPlantDriver:
    """The loop's side of `sim.live.process`.

    `report` (PLANT_REPORT) is the last report of the plant, with true state and node state.
    """

    def __init__(self, folder: Path | str, watchdog: float = 0.02, timeout: float = 1.0) -> None:
        """Connect to the plant in `folder`, whose node's watchdog time may be at most `watchdog` (s).

        `timeout` (s) bounds how long `open` waits for the node.
        """
        self.folder, self.watchdog, self.timeout = Path(folder), watchdog, timeout
        self.report = new_record(PLANT_REPORT)
        self.applied = PASSIVE
        """Last command sent, within the device's limits."""
        self._readings, self._operational = new_record(READINGS), self.report["node"]["operational"]
        self._outgoing = np.zeros(1, PLANT_COMMAND)
        self._incoming: SharedRecord | None = None
        self._sender: SharedRecord | None = None
        self._counter = self._session = 0
        self._last_time = -math.inf

    @property
    def operational(self) -> bool:
        """Whether the node followed commands in the last report."""
        return bool(self._operational[0])

    def open(self) -> None:
        """Attach, read back the node's watchdog and set the node operational with the passive command.

        Raises:
            DriverError: already open, no plant, watchdog missing or too long, or no answer.
        """
        if self._sender is not None:
            raise DriverError("plant driver: open() while already open; call close() first")
        try:
            self._incoming = SharedRecord.open(self.folder / REPORT_FILE, PLANT_REPORT)
            self._sender = SharedRecord.open(self.folder / COMMAND_FILE, PLANT_COMMAND)
            self._last_time = -math.inf
            self._enable(wall.monotonic() + self.timeout)
        except SharedMemoryError as error:
            self._detach()
            raise DriverError(f"plant driver: {error}") from error
        except BaseException:
            self._detach()
            raise

    def read(self, time: float) -> Readings:
        """Return the plant's newest readings with their ages at `time` (s); they age if the plant stalls.

        Raises:
            DriverError: not open, or `time` is not finite or earlier than the last.
        """
        self.read_record(time, self._readings)
        return unpack_readings(self._readings)

    def read_record(self, time: float, record: np.ndarray[Any, Any]) -> None:
        """Write the plant's newest readings with their ages at `time` (s) into a READINGS record.

        Raises:
            DriverError: not open, or `time` is not finite or earlier than the last.
        """
        if self._incoming is None:
            raise _closed("read")
        if not self._last_time <= time < math.inf:
            raise DriverError(
                f"plant driver: read() at invalid time {time} s, expected finite and at least "
                f"{self._last_time} s; pass CLOCK_MONOTONIC"
            )
        self._last_time = time
        self._incoming.read(self.report)
        _take_readings(self.report, record, time)

    def write(self, command: Command) -> Command:
        """Send `command` within the device's limits; return it, or PASSIVE if the node went passive.

        Raises:
            DriverError: not open.
        """
        if self._sender is None:
            raise _closed("write")
        self._send(device_limited(command))
        return self.applied if self._operational[0] else PASSIVE

    def make_passive(self) -> None:
        """Send the passive command if the device is open; otherwise already passive."""
        self.applied = PASSIVE
        with suppress(Exception):  # never raises, whatever the state of the plant
            self._send(PASSIVE)

    def close(self) -> None:
        """Stop the node, which makes it passive, and detach from the plant."""
        self.applied = PASSIVE
        with suppress(Exception):  # whatever the state of the plant
            self._send(PASSIVE, Mode.STOP)
        self._detach()

    def note_truth(self, cycle: np.ndarray[Any, Any]) -> None:
        """Write the fields `plant_*` of a CYCLE record (a one-element array) at the readings' tick."""
        _take_truth(self.report, cycle)

    @property
    def contact(self) -> Contact | None:
        """Contact with the last ball on the tee, in CLOCK_MONOTONIC; None if it was not struck."""
        return contact_in(self.report["contact"])

    def _enable(self, deadline: float) -> None:
        """Start a session with the node and wait for its answer until `deadline` (s)."""
        node = self.report["node"]
        while not self._look():
            self._wait(deadline, "no report")
        watchdog = float(node["watchdog"][0])
        if not 0.0 < watchdog <= self.watchdog + _NEAR:
            found = f"{watchdog:g} s" if watchdog > 0.0 else "none"
            raise DriverError(
                f"plant driver: open() read back the node's watchdog: found {found}, expected one of at most "
                f"{self.watchdog:g} s; start the plant with a shorter one, or raise driver.watchdog"
            )
        # Continue from the last command sent, which the node may not have received yet.
        if self._sender is not None:
            self._sender.read(self._outgoing)
        self._counter = max(int(self._outgoing["counter"][0]), int(node["counter"][0])) & _COUNTERS
        self._session = int(node["session"][0]) + 1
        self._send(PASSIVE, Mode.START)
        while not (self._look() and self._operational[0] and node["session"][0] == self._session):
            self._wait(deadline, f"no answer to session {self._session}")

    def _look(self) -> int:
        return 0 if self._incoming is None else self._incoming.read(self.report)

    def _wait(self, deadline: float, found: str) -> None:
        if wall.monotonic() > deadline:
            raise DriverError(
                f"plant driver: open() found {found} within {self.timeout:g} s, expected the plant process "
                f"at {self.folder} to answer; start it, or restart it if it hangs"
            )
        wall.sleep(_POLL_PERIOD)

    def _send(self, command: Command, mode: Mode = Mode.OPERATE) -> None:
        if self._sender is not None:
            self._counter += 1
            self.applied = command
            self._outgoing[0] = (self._counter, self._session, mode, command)
            self._sender.write(self._outgoing)

    def _detach(self) -> None:
        for shared in (self._incoming, self._sender):
            if shared is not None:
                shared.close()
        self._incoming = self._sender = None
        self._operational[0] = False


@compiled
def _take_readings(report: Any, record: Any, time: float) -> None:
    """Write the readings of a PLANT_REPORT into a READINGS record, as of `time` (s)."""
    given, out = report[0].readings, record[0]
    out.time = time
    for i in range(3):
        out.encoder_count[i], out.encoder_time[i] = given.encoder_count[i], given.encoder_time[i]
        out.encoder_valid[i], out.encoder_indexed[i] = given.encoder_valid[i], given.encoder_indexed[i]
        out.encoder_age[i] = time - given.encoder_time[i]
    out.emergency_stop_clear, out.guard_closed = given.emergency_stop_clear, given.guard_closed
    out.guard_locked, out.local_reset = given.guard_locked, given.local_reset
    out.ball_present, out.supply_pressure = given.ball_present, given.supply_pressure
    for i in range(6):
        out.chamber_pressure[i] = given.chamber_pressure[i]
    for i in range(2):
        out.vent_open[i] = given.vent_open[i]


@compiled
def _take_truth(report: Any, cycle: Any) -> None:
    """Write the truth of a PLANT_REPORT into the fields `plant_*` of a CYCLE record."""
    truth, out = report[0].truth, cycle[0]
    for i in range(3):
        out.plant_angle[i], out.plant_velocity[i] = truth.plant_angle[i], truth.plant_velocity[i]
        out.plant_effort[i] = truth.plant_effort[i]
    for i in range(6):
        out.plant_pressure[i] = truth.plant_pressure[i]
    for i in range(2):
        out.plant_head_position[i] = truth.plant_head_position[i]
    out.plant_head_speed = truth.plant_head_speed


def _closed(call: str) -> DriverError:
    return DriverError(f"plant driver: {call}() while closed; call open() first")
