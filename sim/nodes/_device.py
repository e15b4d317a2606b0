"""A CANopen device (CiA 301): object dictionary from its EDS, SDO, NMT, heartbeat, SYNC, PDO, EMCY.

A device is defined by its EDS file, read as data, and by the objects that a master writes. Time is passed in;
frames are received by `receive` and sent by a given function. This module is independent of the bench's
driver.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import canopen
from canopen.objectdictionary import ODVariable, import_od
from canopen.objectdictionary.datatypes import NUMBER_TYPES, SIGNED_TYPES
from canopen.sdo.exceptions import SdoAbortedError
from canopen.sdo.server import SdoServer

from sim.nodes.personality import Personality

Send = Callable[[int, bytes], None]
"""Sends a frame of identifier and data."""

INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
"""NMT states as in a heartbeat."""

START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
"""NMT commands."""

RPDO_TIMEOUT, HEARTBEAT_LOST, PDO_TOO_SHORT, NO_ERROR = 0x8250, 0x8130, 0x8210, 0x0000
"""Emergency error codes."""
_COMMUNICATION = 0x8000
"""First emergency error code of monitoring and communication errors."""

_ERROR_REGISTER, _SYNC_COB_ID, _EMERGENCY_COB_ID = 0x1001, 0x1005, 0x1014
_CONSUMER_HEARTBEAT, _PRODUCER_HEARTBEAT = 0x1016, 0x1017
_ERROR_BEHAVIOUR = 0x1029, 0x67FE
"""Object of CiA 301, and of older devices of CiA 401."""
SYNC = EMERGENCY = 0x80
"""Identifier of SYNC; an emergency message adds the node's number. Default without 1005h, 1014h."""
_STORE, _SAVE = 0x1010, int.from_bytes(b"save", "little")
_INVALID = 0x80000000
_EVENT = 254
"""First event-driven transmission type of a PDO; lower ones are synchronous."""

_NOT_READABLE, _NOT_WRITABLE, _NO_OBJECT, _NO_SUB_INDEX = 0x06010001, 0x06010002, 0x06020000, 0x06090011
_NOT_MAPPABLE, _PDO_TOO_LONG, _WRONG_LENGTH, _NO_VALUE = 0x06040041, 0x06040042, 0x06070010, 0x060A0023
_TOO_HIGH, _TOO_LOW, _BAD_VALUE, _NOT_NOW = 0x06090031, 0x06090032, 0x06090030, 0x08000022
_NOT_STORED = 0x08000020


@dataclass(frozen=True, slots=True)
class Mapped:
    """One object in a PDO."""

    index: int
    subindex: int
    size: int
    """Size in bytes."""


@dataclass
class Pdo:
    """Present configuration of one PDO."""

    number: int
    """PDO number from 0."""
    identifier: int
    kind: int
    """Transmission type."""
    period: float
    """Event timer, s; infinite if unused."""
    mapped: tuple[Mapped, ...]
    due: float = math.inf
    """Expiry time of the event timer, s."""
    syncs: int = 0
    held: bytes | None = field(default=None, repr=False)
    """Received data to be applied with the next SYNC."""

    @property
    def length(self) -> int:
        """Length of a frame in bytes."""
        return sum(one.size for one in self.mapped)


class _Wire(canopen.Network):
    """Network stub that sends the SDO server's responses."""

    def __init__(self, send: Send) -> None:
        super().__init__(None)
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._send(can_id, bytes(data))


class CanopenDevice:
    """One device. A subclass implements the behaviour: `sampled`, `written` and `fall_back`."""

    def __init__(self, number: int, eds: Path, send: Send, personality: Personality | None = None) -> None:
        """Create node `number` (1 … 127) from the file `eds`; it is unpowered until `boot`.

        A `personality` makes it answer like one family of devices.
        """
        self.number, self._send, self.personality = number, send, personality
        self.object_dictionary = import_od(str(eds), number)
        if personality is not None:
            personality.apply(self.object_dictionary)
        self._objects: dict[tuple[int, int], ODVariable] = {}
        for index, entry in self.object_dictionary.items():
            parts: Any = {0: entry} if isinstance(entry, ODVariable) else entry.subindices
            self._objects |= {(index, subindex): part for subindex, part in parts.items()}
        self.state = INITIALISING
        self.errors = 0
        """Number of emergency messages sent that report an error."""
        self._values: dict[tuple[int, int], bytes] = {}
        self._stored: dict[tuple[int, int], bytes] = {}
        self._sdo = SdoServer(0x600 + number, 0x580 + number, self)
        self._sdo.network = _Wire(self._answer)
        self._storing_until, self._late_answer = -math.inf, b""
        """Until when settings are being stored (s), and the answer to that."""
        self._sdo._index = self._sdo._subindex = 0  # noqa: SLF001 - else its first abort fails
        self._tpdos: list[Pdo] = []
        self._rpdos: dict[int, Pdo] = {}
        self._heartbeat, self._heartbeat_due = math.inf, math.inf
        self._watched: dict[int, tuple[float, float]] = {}
        """Consumer heartbeats: node -> time-out (s), time of expiry (s)."""
        self._sync = SYNC
        self._now = 0.0
        self._fault = False

    # Implemented by subclasses -------------------------------------------------------------------

    def sampled(self) -> bool:
        """Update the objects of a synchronous TPDO; return False to skip this SYNC."""
        return True

    def written(self, index: int) -> None:
        """React to a write to object `index`."""

    def fall_back(self) -> None:
        """Set the outputs to their fallback values."""

    # Operation -----------------------------------------------------------------------------------

    def boot(self, now: float) -> None:
        """Power up at `now` (s) with stored or EDS values: send boot-up, then enter pre-operational."""
        self._now = now
        self._values = self._stored.copy()
        self._watched.clear()
        self._heartbeat = self._heartbeat_due = math.inf
        self._fault = False
        self._read_settings()
        self.fall_back()
        self.state = PRE_OPERATIONAL
        self._send(0x700 + self.number, bytes([INITIALISING]))

    def receive(self, identifier: int, data: bytes, now: float) -> None:
        """Process a data frame received at `now` (s)."""
        self._now = now
        if identifier == self._sync:
            self._receive_sync()
        elif (pdo := self._rpdos.get(identifier)) is not None:
            self._receive_rpdo(pdo, data)
        elif identifier == 0:
            if len(data) == 2 and data[1] in (0, self.number):
                self._obey(data[0])
        elif identifier == 0x600 + self.number:
            if len(data) == 8 and self.state != STOPPED:
                self._sdo.on_request(identifier, bytearray(data), now)
        elif identifier - 0x700 in self._watched:
            period, _ = self._watched[identifier - 0x700]
            self._watched[identifier - 0x700] = period, now + period

    def run_timers(self, now: float) -> None:
        """Do the work due at `now` (s)."""
        self._now = now
        if self._late_answer and now >= self._storing_until:
            late, self._late_answer = self._late_answer, b""
            self._send(0x580 + self.number, late)
        if now >= self._heartbeat_due:
            self._heartbeat_due = now + self._heartbeat
            self._send(0x700 + self.number, bytes([self.state]))
        if self.state != OPERATIONAL:
            # A heartbeat that ends now is watched again from its next one on.
            for node, (period, due) in self._watched.items():
                self._watched[node] = period, due if now < due else math.inf
            return
        for pdo in self._rpdos.values():
            if now >= pdo.due:
                pdo.due = math.inf
                self.fail(RPDO_TIMEOUT, 0x11)
        for node, (period, due) in self._watched.items():
            if now >= due:
                self._watched[node] = period, math.inf
                self.fail(HEARTBEAT_LOST, 0x11)
        for pdo in self._tpdos:
            if now >= pdo.due:
                self._transmit(pdo)

    @property
    def next_due(self) -> float:
        """Time at which `run_timers` is due next, s."""
        dues = [self._heartbeat_due, *(pdo.due for pdo in self._tpdos)]
        dues += [pdo.due for pdo in self._rpdos.values()] + [due for _, due in self._watched.values()]
        return min(*dues, self._storing_until if self._late_answer else math.inf)

    def fail(self, code: int, register: int) -> None:
        """Report a communication error, set the outputs to fallback, and change state according to 1029h."""
        self.send_emergency(code, register)
        behaviour = next((self.number_at(index, 1) for index in _ERROR_BEHAVIOUR if (index, 1) in self), 0)
        if behaviour in (0, 2):
            self._enter(STOPPED if behaviour == 2 else PRE_OPERATIONAL)
        self.fall_back()

    def send_emergency(self, code: int, register: int) -> None:
        """Send an emergency message; code 0 reports the error reset."""
        # A communication error is reset by the next start, unlike a device error.
        self._fault = code >= _COMMUNICATION
        self.errors += code != NO_ERROR
        self.put(_ERROR_REGISTER, 0, register)
        if self.state != STOPPED:
            identifier = self.number_at(_EMERGENCY_COB_ID, otherwise=EMERGENCY + self.number) & 0x7FF
            self._send(identifier, struct.pack("<HB5x", code, register))

    def send_changed(self, index: int) -> None:
        """Send every event-driven TPDO that maps object `index`."""
        if self.state == OPERATIONAL:
            for pdo in self._tpdos:
                if pdo.kind >= _EVENT and any(one.index == index for one in pdo.mapped):
                    self._transmit(pdo)

    # Values --------------------------------------------------------------------------------------

    def __contains__(self, key: tuple[int, int]) -> bool:
        """Return whether the dictionary has the object (index, sub-index)."""
        return key in self._objects

    def number_at(self, index: int, subindex: int = 0, otherwise: int = 0) -> int:
        """Return the value of an integer object, `otherwise` if the device does not have it."""
        if (index, subindex) not in self:
            return otherwise
        signed = self._find(index, subindex).data_type in SIGNED_TYPES
        return int.from_bytes(self.get_data(index, subindex), "little", signed=signed)

    def size_of(self, index: int, subindex: int) -> int:
        """Return the size of an integer object in bytes."""
        return len(self._find(index, subindex)) // 8

    def put(self, index: int, subindex: int, value: int) -> None:
        """Set an object from inside the device, if it has it."""
        if (index, subindex) in self:
            self._values[index, subindex] = self._find(index, subindex).encode_raw(value)

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """Return the bytes of an object for canopen's SDO server.

        Raises:
            SdoAbortedError: the object is missing or not readable.
        """
        found = self._find(index, subindex)
        if check_readable and not found.readable:
            raise SdoAbortedError(_NOT_READABLE)
        kept = self._values.get((index, subindex))
        if kept is not None:
            return kept
        if found.default is None:
            raise SdoAbortedError(_NO_VALUE)
        return bytes(found.encode_raw(found.default))

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        """Write bytes from a master into an object.

        Raises:
            SdoAbortedError: as specified in CiA 301.
        """
        found = self._find(index, subindex)
        if check_writable and not found.writable:
            raise SdoAbortedError(_NOT_WRITABLE)
        if found.data_type in NUMBER_TYPES:
            if 8 * len(data) != len(found):
                raise SdoAbortedError(_WRONG_LENGTH)
            value = int.from_bytes(data, "little", signed=found.data_type in SIGNED_TYPES)
            if found.max is not None and value > found.max:
                raise SdoAbortedError(_TOO_HIGH)
            if found.min is not None and value < found.min:
                raise SdoAbortedError(_TOO_LOW)
            fixed = self.personality is not None and self.personality.fixed_mapping
            if fixed and (0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00):
                raise SdoAbortedError(fixed)
            if 0x1400 <= index < 0x1C00:
                self._check_pdo(index, subindex, value)
            if index == _STORE:
                self._store(value)
                return
        self._values[index, subindex] = bytes(data)
        if index < 0x2000:
            self._read_settings()
        self.written(index)

    def _store(self, value: int) -> None:
        """Store all settings over a power loss."""
        if value != _SAVE:
            raise SdoAbortedError(_NOT_STORED)
        if self.personality is not None:
            self._storing_until = self._now + self.personality.store_time
        self._stored = {
            key: kept
            for key, kept in self._values.items()
            if self._objects[key].writable and not self._objects[key].pdo_mappable
        }

    def _find(self, index: int, subindex: int) -> ODVariable:
        found = self._objects.get((index, subindex))
        if found is None:
            raise SdoAbortedError(_NO_SUB_INDEX if index in self.object_dictionary else _NO_OBJECT)
        return found

    def _answer(self, identifier: int, data: bytes) -> None:
        """Send an SDO response, when storing has ended."""
        if self._now < self._storing_until:
            self._late_answer = data
        else:
            self._send(identifier, data)

    # PDO -----------------------------------------------------------------------------------------

    def _check_pdo(self, index: int, subindex: int, value: int) -> None:
        """Check a PDO setting according to CiA 301.

        Raises:
            SdoAbortedError: a valid PDO is changed, or an object cannot be mapped.
        """
        communication = index & ~0x200 if index & 0x200 else index
        cob_id = self.number_at(communication, 1, otherwise=_INVALID)
        if index == communication:
            if subindex == 1 and not (cob_id | value) & _INVALID and cob_id & 0x7FF != value & 0x7FF:
                raise SdoAbortedError(_BAD_VALUE)
            if subindex == 2 and not (value <= 240 or value >= _EVENT):
                raise SdoAbortedError(_BAD_VALUE)
            if subindex > 2 and not cob_id & _INVALID:
                raise SdoAbortedError(_NOT_NOW)
            return
        if not cob_id & _INVALID:
            raise SdoAbortedError(_NOT_NOW)
        if subindex == 0:
            entries = [self.number_at(index, n) for n in range(1, value + 1) if self._find(index, n)]
            if sum(entry & 0xFF for entry in entries) > 64:
                raise SdoAbortedError(_PDO_TOO_LONG)
            return
        if self.number_at(index):
            raise SdoAbortedError(_NOT_NOW)
        if value:
            mapped = self._find(value >> 16, value >> 8 & 0xFF)
            if not mapped.pdo_mappable or len(mapped) != value & 0xFF:
                raise SdoAbortedError(_NOT_MAPPABLE)

    def _pdos(self, communication: int, mapping: int) -> Iterable[Pdo]:
        """Return the valid PDOs of one direction."""
        for number in range(8):
            if communication + number not in self.object_dictionary:
                continue
            cob_id = self.number_at(communication + number, 1, otherwise=_INVALID)
            count = self.number_at(mapping + number)
            if cob_id & _INVALID or not count:
                continue
            entries = [self.number_at(mapping + number, n) for n in range(1, count + 1)]
            if not all((entry >> 16, entry >> 8 & 0xFF) in self for entry in entries):
                continue
            timer = self.number_at(communication + number, 5)
            yield Pdo(
                number,
                cob_id & 0x7FF,
                self.number_at(communication + number, 2),
                1e-3 * timer or math.inf,
                tuple(Mapped(entry >> 16, entry >> 8 & 0xFF, (entry & 0xFF) // 8) for entry in entries),
            )

    def _read_settings(self) -> None:
        """Read the settings needed for every frame from the dictionary."""
        self._tpdos = list(self._pdos(0x1800, 0x1A00))
        self._rpdos = {pdo.identifier: pdo for pdo in self._pdos(0x1400, 0x1600)}
        if self.state == OPERATIONAL:
            self._start_timers()
        self._sync = self.number_at(_SYNC_COB_ID, otherwise=SYNC) & 0x7FF
        # Older devices have no heartbeat: they answer node guarding only.
        heartbeat = 1e-3 * self.number_at(_PRODUCER_HEARTBEAT) or math.inf
        if heartbeat != self._heartbeat:
            self._heartbeat, self._heartbeat_due = heartbeat, self._now + heartbeat
        watched = {}
        for subindex in range(1, 128):
            if (_CONSUMER_HEARTBEAT, subindex) not in self:
                break
            value = self.number_at(_CONSUMER_HEARTBEAT, subindex)
            node, period = value >> 16 & 0x7F, 1e-3 * (value & 0xFFFF)
            if node and period:
                before = self._watched.get(node, (0.0, 0.0))
                watched[node] = before if before[0] == period else (period, math.inf)
        self._watched = watched

    def _start_timers(self) -> None:
        """Start the event timers of the TPDOs; those of RPDOs start with the first frame."""
        for pdo in self._tpdos:
            pdo.due = self._now + pdo.period if pdo.kind >= _EVENT else math.inf

    def _transmit(self, pdo: Pdo) -> None:
        if pdo.kind >= _EVENT:
            pdo.due = self._now + pdo.period
        self._send(pdo.identifier, b"".join([self.get_data(one.index, one.subindex) for one in pdo.mapped]))

    def _receive_sync(self) -> None:
        if self.state != OPERATIONAL:
            return
        for pdo in self._rpdos.values():
            if pdo.held is not None:
                self._apply(pdo, pdo.held)
                pdo.held = None
        answers = [pdo for pdo in self._tpdos if 0 < pdo.kind <= 240]
        if answers and self.sampled():
            for pdo in answers:
                pdo.syncs += 1
                if pdo.syncs >= pdo.kind:
                    pdo.syncs = 0
                    self._transmit(pdo)

    def _receive_rpdo(self, pdo: Pdo, data: bytes) -> None:
        if self.state != OPERATIONAL:
            return
        if len(data) < pdo.length:
            self.send_emergency(PDO_TOO_SHORT, 0x11)
            return
        pdo.due = self._now + pdo.period
        if pdo.kind < _EVENT:
            pdo.held = data
        else:
            self._apply(pdo, data)

    def _apply(self, pdo: Pdo, data: bytes) -> None:
        at = 0
        for one in pdo.mapped:
            self._values[one.index, one.subindex] = data[at : at + one.size]
            at += one.size
        for index in dict.fromkeys(one.index for one in pdo.mapped):
            self.written(index)

    # NMT -----------------------------------------------------------------------------------------

    def _obey(self, command: int) -> None:
        if command in (RESET_NODE, RESET_COMMUNICATION):
            self.boot(self._now)
        elif command == START:
            self._enter(OPERATIONAL)
        elif command == STOP:
            self._enter(STOPPED)
            self.fall_back()
        elif command == ENTER_PRE_OPERATIONAL:
            self._enter(PRE_OPERATIONAL)

    def _enter(self, state: int) -> None:
        if state == self.state:
            return
        self.state = state
        if state == OPERATIONAL:
            if self._fault:
                self.send_emergency(NO_ERROR, 0)
            self._read_settings()
            for pdo in self._tpdos:
                if pdo.kind >= _EVENT:
                    self._transmit(pdo)
