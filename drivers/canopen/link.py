"""Whole frames to and from any interface of python-can: raw where the socket can be had, else as messages.

Frames are Linux's `struct can_frame` (`drivers.can_bus.FRAME`). What fails does so with OSError and its
number: ENOBUFS when there is no room for a frame, ENETDOWN and the like when the interface is away.
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
from typing import Protocol

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.socketcan.constants import SO_TIMESTAMPNS

from drivers.base import DriverError
from drivers.can_bus import ERROR, EXTENDED, FRAME, REMOTE, LocalSocketBus, message_of
from drivers.canopen.frames import SYNC
from drivers.canopen.settings import CanopenSettings

_SO_RCVBUFFORCE = 33
_RECEIVE_BUFFER = 8 * 2**20
"""Bytes; the kernel's own 212,992 hold 278 frames."""
_STAMP = struct.Struct("@ll")
_TOLD = socket.CMSG_SPACE(_STAMP.size)
_LONGEST_LOOK = 2_000
"""ns that a look at both clocks takes when nothing comes between."""
_LONGEST_ECHO = 0.005
"""s after which an echo is not that of the SYNC sent last."""


class FrameLink(Protocol):
    """One opened interface."""

    def send_frame(self, frame: bytes) -> float:
        """Send and return when that was, s of CLOCK_MONOTONIC; OSError when that fails."""

    def receive_frame(self, timeout: float) -> bytes | None:
        """Return the next frame, None when there is none for `timeout` s; OSError when that fails."""

    def sync_time(self, sent: float) -> float:
        """Return when the SYNC that was sent at `sent` was on the wire, as far as is known by now."""

    def shutdown(self) -> None:
        """Close it. Allowed twice."""


class SocketcanLink:
    """SocketCAN's raw socket, without the messages.

    A SYNC may wait for its turn on the wire: its echo tells when it was there, by the kernel's stamp.
    """

    def __init__(self, bus: SocketcanBus) -> None:
        self._bus, self._socket = bus, bus.socket
        self._echoed = -math.inf
        self._ahead = time.time_ns() - time.monotonic_ns()
        """ns by which the clock of the stamps is ahead."""
        with suppress(OSError):  # needs CAP_NET_ADMIN
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER)

    def send_frame(self, frame: bytes) -> float:
        """Send and return when that was, s of CLOCK_MONOTONIC; OSError when that fails."""
        now = time.monotonic()
        self._socket.send(frame, socket.MSG_DONTWAIT)
        return now

    def receive_frame(self, timeout: float) -> bytes | None:
        """Return the next frame, None when there is none for `timeout` s; OSError when that fails."""
        end = time.monotonic() + timeout
        while True:
            if timeout and not select.select([self._socket], (), (), timeout)[0]:
                return None
            try:
                frame, told, flags, _ = self._socket.recvmsg(FRAME.size, _TOLD, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return None
            if not flags & socket.MSG_CONFIRM:
                return frame
            self._note_echo(told)
            timeout = max(0.0, end - time.monotonic())

    def sync_time(self, sent: float) -> float:
        """Return when the SYNC that was sent at `sent` was on the wire, as far as is known by now."""
        return self._echoed if sent <= self._echoed < sent + _LONGEST_ECHO else sent

    def _note_echo(self, told: list[tuple[int, int, bytes]]) -> None:
        """Note when the own SYNC went out; the only frame of its own that the filters let in."""
        before, now, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < _LONGEST_LOOK:  # else somebody interrupted: what was known stands
            self._ahead = now - (before + after) // 2
        for _, kind, content in told:
            if kind == SO_TIMESTAMPNS:
                seconds, rest = _STAMP.unpack(content)
                self._echoed = 1e-9 * (seconds * 1_000_000_000 + rest - self._ahead)

    def shutdown(self) -> None:
        """Close it. Allowed twice."""
        self._bus.shutdown()


class MessageLink:
    """Any other interface, by python-can's messages."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def send_frame(self, frame: bytes) -> float:
        """Send and return when that was, s of CLOCK_MONOTONIC; OSError when that fails."""
        message = message_of(frame, "")
        now = time.monotonic()
        try:
            self._bus.send(message)
        except can.CanError as error:
            raise OSError(error.error_code or errno.EIO, str(error)) from error
        return now

    def receive_frame(self, timeout: float) -> bytes | None:
        """Return the next frame, None when there is none for `timeout` s; OSError when that fails."""
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
        """Return `sent`: nobody knows better."""
        return sent

    def shutdown(self) -> None:
        """Close it. Allowed twice."""
        self._bus.shutdown()


def open_link(settings: CanopenSettings, identifiers: Sequence[int]) -> FrameLink:
    """Open the interface; of data frames only those with one of `identifiers` come through.

    Raises:
        DriverError: it cannot be opened; the text says what to do.
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
            f"{where}: {error}; set canopen.interface to one that python-can knows (can.VALID_INTERFACES), "
            "or install what it needs"
        ) from error
    except (OSError, can.CanError, ValueError, ImportError) as error:
        cure = (
            f"bring it up: ip link set {settings.channel} up type can bitrate {settings.bitrate}"
            if is_socketcan
            else "correct canopen.interface and canopen.channel, or install what that interface needs"
        )
        raise DriverError(f"{where}: it cannot be opened: {error}; {cure}") from error
    if isinstance(bus, LocalSocketBus):
        return bus
    return SocketcanLink(bus) if isinstance(bus, SocketcanBus) else MessageLink(bus)
