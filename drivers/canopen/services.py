"""Reading and writing the objects of a node (SDO) with canopen's client, without its thread.

Whoever asks takes the frames from the bus itself until the answer is there. What fails is told with node,
object, abort code and cure.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import canopen
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from drivers.base import DriverError
from drivers.canopen.frames import SERVICE_ANSWER, SERVICE_REQUEST, frame

_CURES = {
    0x05040000: "see whether the node has power and this number, and the bus its bit rate and terminators",
    0x06010002: "the device has this value fixed: set it at the device, or take another one",
    0x06020000: "the device has no such object: see its manual, correct [canopen], or take another one",
    0x06040041: "the device cannot put this object into a PDO: see its manual for one that it can",
    0x06040042: "the device takes no PDO of this length",
    0x06090011: "the device has no such sub-index: see its manual, correct [canopen], or take another one",
    0x08000022: "the node refuses in its present state: switch its power off and on",
}


_ABORT = 0x80
"""Command specifier."""


class ServiceError(DriverError):
    """An object could not be read or written."""

    def __init__(self, text: str, code: int = 0) -> None:
        """`code` is the abort code, 0 when none came."""
        super().__init__(text)
        self.code = code


class Node:
    """One node as the start-up sees it; `role` names it in messages."""

    def __init__(
        self,
        number: int,
        role: str,
        send: Callable[[bytes], None],
        take: Callable[[float], tuple[int, bytes] | None],
        clock: Callable[[], float],
        timeout: float,
    ) -> None:
        """`take` gets the next frame (identifier, data) within a time (s), `timeout` bounds an answer (s)."""
        self.number, self.role = number, role
        self._client = _PolledClient(number, send, take, clock, timeout)

    def read(self, index: int, subindex: int, name: str) -> int:
        """Return an unsigned number.

        Raises:
            ServiceError: the node refuses or does not answer.
        """
        try:
            return int.from_bytes(self._client.upload(index, subindex), "little")
        except (SdoAbortedError, SdoCommunicationError, struct.error, OSError) as error:
            raise self._failure("read", index, subindex, name, error) from error

    def write(self, index: int, subindex: int, value: int, size: int, name: str) -> None:
        """Write an unsigned number of `size` bytes.

        Raises:
            ServiceError: the node refuses or does not answer.
        """
        try:
            self._client.download(index, subindex, value.to_bytes(size, "little"))
        except (SdoAbortedError, SdoCommunicationError, struct.error, OSError) as error:
            raise self._failure(f"set to {value:#x}", index, subindex, name, error) from error

    def set(self, index: int, subindex: int, value: int, size: int, name: str, mask: int = -1) -> None:
        """Write a number and read it back; bits outside of `mask` are the device's own.

        Raises:
            ServiceError: the node refuses, does not answer, or has another value afterwards.
        """
        self.write(index, subindex, value, size, name)
        self.expect(index, subindex, value, name, "take a device that keeps what is set", mask)

    def expect(self, index: int, subindex: int, value: int, name: str, cure: str, mask: int = -1) -> None:
        """Read a number and refuse another one than `value`.

        Raises:
            ServiceError: it is another one, or cannot be read.
        """
        found = self.read(index, subindex, name)
        if (found ^ value) & mask:
            raise ServiceError(
                f"{self.place(index, subindex, name)}: found {found:#x}, expected {value:#x}; {cure}"
            )

    def place(self, index: int, subindex: int, name: str) -> str:
        """Return node and object in words."""
        return f"canopen: node {self.number} ({self.role}), object {index:04X}h:{subindex} ({name})"

    def _failure(self, what: str, index: int, subindex: int, name: str, error: Exception) -> ServiceError:
        place = self.place(index, subindex, name)
        match error:
            case SdoAbortedError():
                cure = _CURES.get(error.code, "see the device's manual")
                text = SdoAbortedError.CODES.get(error.code, "a code of the device's own")
                told = f"cannot be {what}: abort code {error.code:08X}h, {text}; {cure}"
                return ServiceError(f"{place}: {told}", error.code)
            case OSError():
                return ServiceError(f"{place}: cannot be {what}: {error}; see whether the interface is up")
            case _:
                return ServiceError(f"{place}: cannot be {what}: {error}; {_CURES[0x05040000]}")


class _PolledClient(SdoClient):
    """canopen's client of one node, which waits for answers by taking frames itself."""

    def __init__(
        self,
        number: int,
        send: Callable[[bytes], None],
        take: Callable[[float], tuple[int, bytes] | None],
        clock: Callable[[], float],
        timeout: float,
    ) -> None:
        super().__init__(  # type: ignore[no-untyped-call]
            SERVICE_REQUEST + number, SERVICE_ANSWER + number, ObjectDictionary()
        )
        self.network = _Sender(send)
        self._take, self._clock, self._timeout = take, clock, timeout

    def read_response(self) -> bytes:
        """Wait for the node's answer."""
        end = self._clock() + self._timeout
        while self.responses.empty():
            left = end - self._clock()
            if left <= 0.0:
                raise SdoCommunicationError(f"no answer within {self._timeout:g} s")
            heard = self._take(left)
            if heard is not None and heard[0] == self.tx_cobid:
                self.on_response(heard[0], heard[1], 0.0)  # type: ignore[no-untyped-call]
        return super().read_response()  # type: ignore[no-any-return, no-untyped-call]

    def abort(self, abort_code: int = 0x08000000) -> None:
        """Tell the node that the transfer is given up; whoever asked hears of it by the exception."""
        self.send_request(struct.pack("<B3xL", _ABORT, abort_code))  # type: ignore[no-untyped-call]


class _Sender(canopen.Network):
    """What the client sends into."""

    def __init__(self, send: Callable[[bytes], None]) -> None:
        super().__init__(None)
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._send(frame(can_id, bytes(data)))
