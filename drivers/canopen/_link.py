"""Send, receive and count frames on any python-can interface: by raw socket if possible, else as messages.

Frames are Linux's `struct can_frame` (`drivers.can_bus.FRAME`). Failures raise OSError with errno: ENOBUFS
when the transmit queue is full, ENETDOWN and the like when the interface is down.
"""

from __future__ import annotations

import errno
import math
import select
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.socketcan.constants import SO_TIMESTAMPNS

from drivers.base import DriverError
from drivers.base.clocks import WallOffset
from drivers.can_bus import ERROR, EXTENDED, FRAME, REMOTE, LocalSocketBus, message_of
from drivers.canopen.frames import MAX_ECHO_DELAY, SYNC
from drivers.canopen.settings import CanopenSettings


@dataclass(slots=True)
class BusCounters:
    """Counts since the driver was created; closing and opening do not reset them."""

    frames: int = 0
    """Received frames."""
    positions: int = 0
    """Samples received in time."""
    late: int = 0
    """Samples received after their tick had stopped waiting."""
    duplicates: int = 0
    """Repeated samples of one SYNC."""
    inputs: int = 0
    analogue: int = 0
    heartbeats: int = 0
    boot_ups: int = 0
    emergencies: int = 0
    services: int = 0
    """SDO responses."""
    wrong_length: int = 0
    """Frames with a known identifier and the wrong length."""
    error_frames: int = 0
    foreign: int = 0
    """Frames with an identifier that the bench does not use."""

    syncs: int = 0
    missing: int = 0
    """Samples not received before the next SYNC."""
    floods: int = 0
    """Ticks in which more frames were queued than could be processed."""
    overruns: int = 0
    """Error frames that report frames lost in the controller."""
    error_passive: int = 0
    bus_off: int = 0
    no_room: int = 0
    """Frames not sent because the queue was full (ENOBUFS)."""
    send_failures: int = 0
    """Frames not sent because the interface was down, or for another reason."""
    receive_failures: int = 0
    recoveries: int = 0
    """Times that reopening cleared a fault."""

    def counts(self) -> dict[str, int]:
        """Return all counters by name."""
        return {name: getattr(self, name) for name in self.__slots__}


_SO_RCVBUFFORCE = 33
_RECEIVE_BUFFER = 8 * 2**20
"""Receive buffer in bytes; the kernel's default of 212,992 holds 278 frames."""
_STAMP = struct.Struct("@ll")
_ANCILLARY_SIZE = socket.CMSG_SPACE(_STAMP.size)


def whole_frame(received: bytes) -> bytes:
    """Return a frame as the kernel gave it.

    Raises:
        OSError: it was cut short.
    """
    if len(received) != FRAME.size:
        raise OSError(errno.EBADMSG, f"found a frame of {len(received)} bytes, expected {FRAME.size}")
    return received


class FrameLink(Protocol):
    """One opened interface."""

    def send_frame(self, frame: bytes) -> float:
        """Send `frame` and return the send time (s, CLOCK_MONOTONIC); OSError on failure."""

    def receive_frame(self, timeout: float) -> bytes | None:
        """Return the next frame, or None after `timeout` s; OSError on failure."""

    def sync_time(self, sent: float) -> float:
        """Return when the SYNC sent at `sent` was on the wire, or `sent` if not yet known (s)."""

    def shutdown(self) -> None:
        """Close the interface. May be called twice."""


class SocketcanLink:
    """A raw SocketCAN socket, without python-can messages.

    A SYNC may be delayed by arbitration: its echo carries the kernel's time stamp of transmission.
    """

    def __init__(self, bus: SocketcanBus) -> None:
        self._bus, self._socket = bus, bus.socket
        self.echoed = -math.inf
        """Transmission time of the last own SYNC (s)."""
        self.wall = WallOffset()
        with suppress(OSError):  # needs CAP_NET_ADMIN
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER)

    @property
    def descriptor(self) -> int:
        """File descriptor of the socket, for compiled code."""
        return int(self._socket.fileno())

    def send_frame(self, frame: bytes) -> float:
        """Send `frame` and return the send time (s, CLOCK_MONOTONIC); OSError on failure."""
        now = time.monotonic()
        self._socket.send(frame, socket.MSG_DONTWAIT)
        return now

    def receive_frame(self, timeout: float) -> bytes | None:
        """Return the next frame, or None after `timeout` s; OSError on failure."""
        end = time.monotonic() + timeout
        while True:
            if timeout and not select.select([self._socket], (), (), timeout)[0]:
                return None
            try:
                frame, ancillary, flags, _ = self._socket.recvmsg(
                    FRAME.size, _ANCILLARY_SIZE, socket.MSG_DONTWAIT
                )
            except BlockingIOError:
                return None
            if not flags & socket.MSG_CONFIRM:
                return whole_frame(frame)
            self._note_echo(ancillary)
            timeout = max(0.0, end - time.monotonic())

    def sync_time(self, sent: float) -> float:
        """Return when the SYNC sent at `sent` was on the wire, or `sent` if not yet known (s)."""
        return self.echoed if sent <= self.echoed < sent + MAX_ECHO_DELAY else sent

    def _note_echo(self, ancillary: list[tuple[int, int, bytes]]) -> None:
        """Note when the own SYNC was transmitted; the filters pass no other own frame."""
        ahead = self.wall.read()
        for _, kind, content in ancillary:
            if kind == SO_TIMESTAMPNS:
                seconds, rest = _STAMP.unpack(content)
                self.echoed = 1e-9 * (seconds * 1_000_000_000 + rest - ahead)

    def shutdown(self) -> None:
        """Close the interface. May be called twice."""
        self._bus.shutdown()


class MessageLink:
    """Any other interface, by python-can messages."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def send_frame(self, frame: bytes) -> float:
        """Send `frame` and return the send time (s, CLOCK_MONOTONIC); OSError on failure."""
        message = message_of(frame, "")
        now = time.monotonic()
        try:
            self._bus.send(message)
        except can.CanError as error:
            raise OSError(error.error_code or errno.EIO, str(error)) from error
        return now

    def receive_frame(self, timeout: float) -> bytes | None:
        """Return the next frame, or None after `timeout` s; OSError on failure."""
        try:
            message = self._bus.recv(timeout)
        except can.CanError as error:
            raise OSError(error.error_code or errno.EIO, str(error)) from error
        if message is None:
            return None
        flags = (
            message.is_extended_id * EXTENDED
            | message.is_remote_frame * REMOTE
            | message.is_error_frame * ERROR
        )
        return FRAME.pack(message.arbitration_id | flags, message.dlc & 0xF, bytes(message.data[:8]))

    def sync_time(self, sent: float) -> float:
        """Return `sent`: no better time stamp is available."""
        return sent

    def shutdown(self) -> None:
        """Close the interface. May be called twice."""
        self._bus.shutdown()


def open_link(settings: CanopenSettings, identifiers: Sequence[int]) -> FrameLink:
    """Open the interface and filter data frames by `identifiers`.

    Raises:
        DriverError: it cannot be opened; the message names the action.
    """
    filters = [{"can_id": identifier, "can_mask": 0x7FF, "extended": False} for identifier in identifiers]
    is_socketcan = settings.interface == "socketcan"
    if is_socketcan:
        filters.append({"can_id": SYNC, "can_mask": 0x7FF, "extended": False})  # its echo
    where = f"canopen: interface {settings.interface!r}, channel {settings.channel!r}"
    try:
        bus = can.Bus(
            interface=settings.interface,
            channel=settings.channel,
            bitrate=settings.bitrate,
            can_filters=filters,
            receive_own_messages=is_socketcan,
        )
    except can.CanInterfaceNotImplementedError as error:
        raise DriverError(
            f"{where}: {error}; set canopen.interface to one that python-can supports "
            "(can.VALID_INTERFACES), or install its package"
        ) from error
    except (OSError, can.CanError, ValueError, ImportError) as error:
        action = (
            f"bring it up: ip link set {settings.channel} up type can bitrate {settings.bitrate}"
            if is_socketcan
            else "correct canopen.interface and canopen.channel, or install the interface's package"
        )
        raise DriverError(f"{where}: cannot be opened: {error}; {action}") from error
    if isinstance(bus, LocalSocketBus):
        return bus
    return SocketcanLink(bus) if isinstance(bus, SocketcanBus) else MessageLink(bus)
