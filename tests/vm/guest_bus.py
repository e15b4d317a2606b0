"""Frames on the wire seen from the third card, and the kernel's counts, without any disturbance."""

from __future__ import annotations

import fcntl
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from drivers.can_bus import FRAME

_SO_TIMESTAMPNS, _SO_RCVBUFFORCE = 35, 33
_STAMP = struct.Struct("=qq")
_FILTER = struct.Struct("=II")
_EXACT = 0x7FF | 0x80000000 | 0x40000000
"""Mask of a filter that takes one identifier of a data frame: the kernel counts its matches."""
_IFREQ = struct.Struct("=16sh22x")
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _IFF_UP = 0x8913, 0x8914, 1
_BUFFER = 8 * 2**20


class Frame(NamedTuple):
    """One frame and when it came."""

    time: float
    """s of CLOCK_MONOTONIC, by the kernel's stamp."""
    identifier: int
    data: bytes


class Listener:
    """A raw socket on one interface, which keeps frames until they are read."""

    def __init__(self, interface: str, identifiers: Sequence[int] = (), buffer: int = _BUFFER) -> None:
        """Take `identifiers`, everything when there are none; `buffer` in bytes."""
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        if identifiers:
            filters = b"".join(_FILTER.pack(identifier, _EXACT) for identifier in identifiers)
            self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
        self.socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, buffer)
        self.socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self.socket.bind((interface,))
        self._ahead = time.time_ns() - time.monotonic_ns()

    def frames(self) -> Iterator[Frame]:
        """Yield all that has come."""
        while True:
            try:
                whole, told, _, _ = self.socket.recvmsg(FRAME.size, 64, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            seconds, rest = _STAMP.unpack(told[0][2])
            identifier, length, data = FRAME.unpack(whole)
            yield Frame(1e-9 * (seconds * 10**9 + rest - self._ahead), identifier, data[:length])

    def close(self) -> None:
        """Close it."""
        self.socket.close()


def send(interface: str, identifier: int, data: bytes) -> None:
    """Send one frame, flags in its identifier."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
        sender.bind((interface,))
        sender.send(FRAME.pack(identifier, len(data), data))


def switch_link(interface: str, *, up: bool) -> None:
    """Do as `ip link set up` or `down`, at once."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        name = interface.encode()
        _, flags = _IFREQ.unpack(fcntl.ioctl(any_socket, _SIOCGIFFLAGS, _IFREQ.pack(name, 0)))
        flags = flags | _IFF_UP if up else flags & ~_IFF_UP
        fcntl.ioctl(any_socket, _SIOCSIFFLAGS, _IFREQ.pack(name, flags))


COUNTED = ("tx_packets", "rx_packets", "tx_dropped", "rx_dropped", "rx_over_errors", "rx_errors", "tx_errors")


def interface_counters(*interfaces: str) -> dict[str, dict[str, int]]:
    """Return the kernel's counters of each interface, all at one instant at which nothing is sent."""
    while True:
        found = _read_counters(interfaces)
        if found == _read_counters(interfaces):
            return found


def _read_counters(interfaces: Sequence[str]) -> dict[str, dict[str, int]]:
    top = Path("/sys/class/net")
    return {
        name: {what: int((top / name / "statistics" / what).read_text()) for what in COUNTED}
        for name in interfaces
    }


def matches(interface: str) -> dict[int, int]:
    """Return how many frames of each identifier came for the exact filters on `interface`."""
    found: dict[int, int] = {}
    for line in Path("/proc/net/can/rcvlist_sff").read_text().splitlines():
        words = line.split()
        if words[:1] == [interface]:
            identifier, count = int(words[1], 16) & 0x7FF, int(words[5])
            found[identifier] = max(found.get(identifier, 0), count)
    return found
