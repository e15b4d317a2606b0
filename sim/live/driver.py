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
from numba import carray

from drivers.base import PASSIVE, Command, DriverError, Readings, device_limited
from drivers.base.compiled import new_record, numbers
from drivers.base.compiled_slots import fetch_record, put_record, slots_at
from drivers.base.native import compiled_call, limit_command, rest_command
from drivers.base.native_calls import DECLINED, DONE, OPERATIONAL, NativeCall, NativeCalls
from drivers.base.raw_memory import copy_bytes, pointer
from drivers.base.records import COMMAND, READINGS, TRUTH, pack_command, unpack_command, unpack_readings
from drivers.base.shared_record import SharedMemoryError, SharedRecord
from sim.live.exchange import COMMAND_FILE, PLANT_COMMAND, PLANT_REPORT, REPORT_FILE
from sim.live.valve_watchdog import Mode
from sim.truth import Contact, contact_in

_NEAR = 1e-9
_SESSION = np.dtype([("counter", "i8"), ("number", "i8"), ("last_time", "f8")])
"""Number of the last command sent and of the session with the node; time of the last reading, s."""
_COMMAND_SIZE, _COMMAND_AT = COMMAND.itemsize, PLANT_COMMAND.fields["command"][1]  # type: ignore[index]
_READINGS_SIZE, _READINGS_AT = READINGS.itemsize, PLANT_REPORT.fields["readings"][1]  # type: ignore[index]
_TRUTH_SIZE, _TRUTH_AT = TRUTH.itemsize, PLANT_REPORT.fields["truth"][1]  # type: ignore[index]
_OPERATE = int(Mode.OPERATE)
_INCOMING, _SENDER, _REPORT, _MIN_MARGIN, _APPLIED, _OUTGOING, _LINK = range(7)
"""Addresses in the block: the blocks of the report's and the commands' file (0 while detached), report,
memory for a copy of it, command applied last, message that carries it, session."""
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
        self._applied = new_record(COMMAND)
        pack_command(PASSIVE, self._applied)
        self._readings, self._operational = new_record(READINGS), numbers(self.report["node"]["operational"])
        self._outgoing, self._spare = new_record(PLANT_COMMAND), new_record(PLANT_REPORT)
        self._incoming: SharedRecord | None = None
        self._sender: SharedRecord | None = None
        self._session = new_record(_SESSION)
        fields = (numbers(self._session[name]) for name in _SESSION.names or ())
        self._counter, self._number, self._last_time = fields
        self._last_time[0] = -math.inf
        held = self.report, self._spare, self._applied, self._outgoing, self._session
        self._block = np.array([0, 0, *(array.ctypes.data for array in held)], np.int64)

    @property
    def operational(self) -> bool:
        """Whether the node followed commands in the last report."""
        return bool(self._operational[0])

    @property
    def applied(self) -> Command:
        """Last command sent, within the device's limits."""
        return unpack_command(self._applied)

    def native_calls(self) -> NativeCalls:
        """Return the native functions."""
        functions = _read_native, _write_native, _note_truth_native
        return NativeCalls(*(NativeCall(one.address, self._block.ctypes.data) for one in functions))

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
            self._block[_INCOMING] = self._incoming.block.ctypes.data
            self._block[_SENDER] = self._sender.block.ctypes.data
            self._last_time[0] = -math.inf
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
        if not self._last_time[0] <= time < math.inf:
            raise DriverError(
                f"plant driver: read() at invalid time {time} s, expected finite and at least "
                f"{self._last_time[0]} s; pass CLOCK_MONOTONIC"
            )
        self._last_time[0] = time
        self._incoming.read(self.report)
        record[...] = self.report["readings"]
        record["time"] = time
        record["encoder_age"] = time - record["encoder_time"]

    def write(self, command: Command) -> Command:
        """Send `command` within the device's limits; return it, or PASSIVE if the node went passive.

        Raises:
            DriverError: not open.
        """
        if self._sender is None:
            raise _closed("write")
        applied = device_limited(command)
        self._send(applied)
        return applied if self._operational[0] else PASSIVE

    def make_passive(self) -> None:
        """Send the passive command if the device is open; otherwise already passive."""
        pack_command(PASSIVE, self._applied)
        with suppress(Exception):  # never raises, whatever the state of the plant
            self._send(PASSIVE)

    def close(self) -> None:
        """Stop the node, which makes it passive, and detach from the plant."""
        pack_command(PASSIVE, self._applied)
        with suppress(Exception):  # whatever the state of the plant
            self._send(PASSIVE, Mode.STOP)
        self._detach()

    def note_truth(self, cycle: np.ndarray[Any, Any]) -> None:
        """Write the fields `plant_*` of a CYCLE record (a one-element array) at the readings' tick."""
        for name in TRUTH.names or ():
            cycle[name] = self.report["truth"][name]

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
        self._counter[0] = max(int(self._outgoing["counter"][0]), int(node["counter"][0])) & _COUNTERS
        self._number[0] = session = int(node["session"][0]) + 1
        self._send(PASSIVE, Mode.START)
        while not (self._look() and self._operational[0] and node["session"][0] == session):
            self._wait(deadline, f"no answer to session {session}")

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
            self._counter[0] += 1
            pack_command(command, self._applied)
            self._outgoing[0] = (self._counter[0], self._number[0], mode, command)
            self._sender.write(self._outgoing)

    def _detach(self) -> None:
        self._block[_INCOMING] = self._block[_SENDER] = 0
        for shared in (self._incoming, self._sender):
            if shared is not None:
                shared.close()
        self._incoming = self._sender = None
        self._operational[0] = False


@compiled_call
def _read_native(block: int, record: int, _: int, time: float) -> int:
    a = carray(pointer(block), 7, np.int64)
    session = carray(pointer(a[_LINK]), 1, _SESSION)[0]
    if a[_INCOMING] == 0 or not session.last_time <= time < np.inf:
        return DECLINED
    if not fetch_record(slots_at(a[_INCOMING]), a[_REPORT], a[_MIN_MARGIN]):
        return DECLINED
    session.last_time = time
    copy_bytes(a[_REPORT] + _READINGS_AT, record, _READINGS_SIZE)
    out = carray(pointer(record), 1, READINGS)[0]
    out.time = time
    for i in range(3):
        out.encoder_age[i] = time - out.encoder_time[i]
    return DONE | OPERATIONAL if carray(pointer(a[_REPORT]), 1, PLANT_REPORT)[0].node.operational else DONE


@compiled_call
def _write_native(block: int, command: int, applied: int, time: float) -> int:
    a = carray(pointer(block), 7, np.int64)
    if a[_SENDER] == 0:
        return DECLINED
    session = carray(pointer(a[_LINK]), 1, _SESSION)[0]
    out = carray(pointer(a[_OUTGOING]), 1, PLANT_COMMAND)[0]
    limited = carray(pointer(applied), 1, COMMAND)
    limit_command(carray(pointer(command), 1, COMMAND), limited)
    out.counter, out.session, out.mode = session.counter + 1, session.number, _OPERATE
    copy_bytes(applied, a[_OUTGOING] + _COMMAND_AT, _COMMAND_SIZE)
    if not put_record(slots_at(a[_SENDER]), a[_OUTGOING]):
        return DECLINED
    session.counter += 1
    copy_bytes(applied, a[_APPLIED], _COMMAND_SIZE)
    if not carray(pointer(a[_REPORT]), 1, PLANT_REPORT)[0].node.operational:
        rest_command(limited)
    return DONE


@compiled_call
def _note_truth_native(block: int, truth: int, _: int, time: float) -> int:
    a = carray(pointer(block), 7, np.int64)
    copy_bytes(a[_REPORT] + _TRUTH_AT, truth, _TRUTH_SIZE)
    return DONE


def _closed(call: str) -> DriverError:
    return DriverError(f"plant driver: {call}() while closed; call open() first")
