"""Read and write the objects of a node (SDO) with canopen's client, without its thread.

The caller receives frames from the bus until the response arrives. Errors name node, object, abort code and
action.

A node has one pair of identifiers for all clients: a bench that starts and a scan, or a vendor's tool, get
each other's responses. Only those that belong to the own request count: an abort for another client would
otherwise read as "no such object", and a late response as one to the next question.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import canopen
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from drivers.base import DriverError
from drivers.canopen.frames import SDO_REQUEST, SDO_RESPONSE, frame

MISSING = frozenset({0x06020000, 0x06090011})
"""Abort codes: no such object, no such sub-index."""

_ACTIONS = {
    0x05040000: "check the node's power and number, and the bit rate and terminators of the bus",
    0x06010002: "the value is fixed in the device: set it at the device, or use another device",
    0x06020000: "the device has no such object: see its manual, correct [canopen], or use another device",
    0x06040041: "the device cannot map this object into a PDO: see its manual for a mappable one",
    0x06040042: "the device does not accept a PDO of this length",
    0x06070010: "the object has another size in the device: see its manual, or use another device",
    0x06070012: "the object is shorter in the device: see its manual, or use another device",
    0x06070013: "the object is longer in the device: see its manual, or use another device",
    0x06090011: "the device has no such sub-index: see its manual, correct [canopen], or use another device",
    0x08000022: "the node refuses in its present state: cycle its power",
}


_MAX_RESPONSES = 64
"""Responses to one request: a text of 440 characters; a node that never ends must not hold the startup."""
_ABORT = 0x80
"""Command specifier."""
_RESPONSES = {0x20: 0x60, 0x00: 0x20, 0x40: 0x40, 0x60: 0x00}
"""Command specifiers of downloads and uploads: request -> response."""
_SPECIFIER, _TOGGLE = 0xE0, 0x10
"""Bits of a command."""
_SEGMENTS = frozenset({0x00, 0x60})
"""Specifiers of requests that name no object."""
_NO_OBJECT = bytes(3)
"""Object that some devices name in every abort."""


class ServiceError(DriverError):
    """An object could not be read or written."""

    def __init__(self, text: str, code: int = 0) -> None:
        """`code` is the SDO abort code, 0 if none."""
        super().__init__(text)
        self.code = code


class Node(SdoClient):
    """SDO access to one node during startup; `role` names it in messages.

    It receives frames itself while it waits for a response.
    """

    def __init__(
        self,
        number: int,
        role: str,
        send: Callable[[bytes], None],
        take: Callable[[float], tuple[int, bytes] | None],
        clock: Callable[[], float],
        timeout: float,
    ) -> None:
        """`take` receives the next frame (identifier, data) within a time (s); `timeout` (s) per response."""
        super().__init__(  # type: ignore[no-untyped-call]
            SDO_REQUEST + number, SDO_RESPONSE + number, ObjectDictionary()
        )
        self.number, self.role = number, role
        self.network = _Sender(send)
        self._take, self._clock, self._timeout = take, clock, timeout
        self._left = 0
        """Responses that the present dialogue may still have."""
        self._request, self._object = bytes(8), _NO_OBJECT
        """The last request, and index and sub-index of its dialogue."""

    def read(self, index: int, subindex: int, name: str) -> int:
        """Return an unsigned number.

        Raises:
            ServiceError: the node refuses or does not answer.
        """
        return int.from_bytes(self.read_bytes(index, subindex, name), "little")

    def read_bytes(self, index: int, subindex: int, name: str) -> bytes:
        """Return the content of an object in the size that the device gives it.

        Raises:
            ServiceError: the node refuses or does not answer.
        """
        try:
            with self._time_limit(None):
                return bytes(self.upload(index, subindex))
        except (SdoAbortedError, SdoCommunicationError, struct.error, OSError) as error:
            raise self._failure("read", index, subindex, name, error) from error

    def find(self, index: int, subindex: int, name: str) -> bytes | None:
        """Return the content of an object, or None if the device does not have it.

        Raises:
            ServiceError: the node refuses for another reason or does not answer.
        """
        try:
            return self.read_bytes(index, subindex, name)
        except ServiceError as error:
            if error.code not in MISSING:
                raise
            return None

    def write(
        self, index: int, subindex: int, value: int, size: int, name: str, timeout: float | None = None
    ) -> None:
        """Write an unsigned number of `size` bytes; `timeout` (s) if the answer may take longer than usual.

        Raises:
            ServiceError: the node refuses or does not answer.
        """
        try:
            with self._time_limit(timeout):
                self.download(index, subindex, value.to_bytes(size, "little"))
        except (SdoAbortedError, SdoCommunicationError, struct.error, OSError) as error:
            raise self._failure(f"set to {value:#x}", index, subindex, name, error) from error

    def set_if_different(self, index: int, subindex: int, value: int, name: str) -> bool:
        """Set a value in the size of the device's own answer; return whether it was different before.

        The value is read back in either case.

        Raises:
            ServiceError: the node refuses, does not answer, or reads back another value.
        """
        found = self.read_bytes(index, subindex, name)
        if int.from_bytes(found, "little") == value:
            return False
        size = len(found)
        if value >= 1 << 8 * size:
            raise ServiceError(
                f"{self.location(index, subindex, name)}: found {size} bytes, which cannot hold {value:#x}; "
                "see the device's manual, or use another device"
            )
        self.set(index, subindex, value, size, name)
        return True

    def set(self, index: int, subindex: int, value: int, size: int, name: str, mask: int = -1) -> None:
        """Write a number and read it back; bits outside `mask` are not compared.

        Raises:
            ServiceError: the node refuses, does not answer, or reads back another value.
        """
        self.write(index, subindex, value, size, name)
        self.expect(index, subindex, value, name, "use a device that keeps its settings", mask)

    def expect(self, index: int, subindex: int, value: int, name: str, action: str, mask: int = -1) -> None:
        """Read a number and require `value`.

        Raises:
            ServiceError: the value differs or cannot be read.
        """
        found = self.read(index, subindex, name)
        if (found ^ value) & mask:
            raise ServiceError(
                f"{self.location(index, subindex, name)}: found {found:#x}, expected {value:#x}; {action}"
            )

    def location(self, index: int, subindex: int, name: str) -> str:
        """Return node and object as text."""
        return f"canopen: node {self.number} ({self.role}), object {index:04X}h:{subindex} ({name})"

    def _failure(self, what: str, index: int, subindex: int, name: str, error: Exception) -> ServiceError:
        location = self.location(index, subindex, name)
        match error:
            case SdoAbortedError():
                action = _ACTIONS.get(error.code, "see the device's manual")
                text = SdoAbortedError.CODES.get(error.code, "a device-specific code")
                message = f"{location}: cannot be {what}: abort code {error.code:08X}h, {text}; {action}"
                return ServiceError(message, error.code)
            case OSError():
                return ServiceError(f"{location}: cannot be {what}: {error}; check that the interface is up")
            case _:
                return ServiceError(f"{location}: cannot be {what}: {error}; {_ACTIONS[0x05040000]}")

    # canopen's client ----------------------------------------------------------------------------

    @contextmanager
    def _time_limit(self, timeout: float | None) -> Iterator[None]:
        """Begin a dialogue with up to `timeout` (s) for each response; None for the usual time."""
        usual, self._left = self._timeout, _MAX_RESPONSES
        self._timeout = usual if timeout is None else timeout
        try:
            yield
        finally:
            self._timeout = usual

    def send_request(self, request: bytes) -> None:
        """Send a request and remember what its response must look like."""
        self._request = bytes(request)
        if request[0] & _SPECIFIER not in _SEGMENTS:
            self._object = self._request[1:4]
        super().send_request(request)  # type: ignore[no-untyped-call]

    def read_response(self) -> bytes:
        """Wait for the node's response to the last request; others are ignored."""
        self._left -= 1
        foreign = 0
        if self._left < 0:
            raise SdoCommunicationError(f"no end after {_MAX_RESPONSES} segments")
        end = self._clock() + self._timeout
        while self.responses.empty():
            left = end - self._clock()
            if left <= 0.0:
                text = f"no answer within {self._timeout:g} s"
                if foreign:
                    text += f", but {foreign} to other questions; another client asks this node"
                raise SdoCommunicationError(text)
            received = self._take(left)
            if received is None or received[0] != self.tx_cobid:
                continue
            if self._is_answer(received[1]):
                self.on_response(received[0], received[1], 0.0)  # type: ignore[no-untyped-call]
            else:
                foreign += 1
        return super().read_response()  # type: ignore[no-any-return, no-untyped-call]

    def _is_answer(self, response: bytes) -> bool:
        """Whether `response` belongs to the last request; a fragment does, to be refused."""
        if len(response) < len(self._request):
            return True
        if response[0] == _ABORT:
            return response[1:4] in {self._object, _NO_OBJECT}
        asked = self._request[0] & _SPECIFIER
        if response[0] & _SPECIFIER != _RESPONSES.get(asked, -1):
            return False
        if asked in _SEGMENTS:
            return (response[0] ^ self._request[0]) & _TOGGLE == 0
        return response[1:4] == self._object

    def abort(self, abort_code: int = 0x08000000) -> None:
        """Send an abort to the node; the caller gets the exception."""
        self.send_request(struct.pack("<B3xL", _ABORT, abort_code))


class _Sender(canopen.Network):
    """Network stub that sends the client's frames."""

    def __init__(self, send: Callable[[bytes], None]) -> None:
        super().__init__(None)
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._send(frame(can_id, bytes(data)))
