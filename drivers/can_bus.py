"""A CAN bus between processes of one machine, without any CAN in the kernel: interface `local_socket`.

Every participant listens on a separate Unix socket in one folder and connects to those of all others; a
frame goes to each of them as a Linux `struct can_frame` of 16 bytes. Nothing leaves the machine, and the
folder belongs to one user alone. Unlike a wire, the bus has no bit timing, arbitration or acknowledgement.
A participant that does not read loses frames (about 280 of each sender are queued) and delays no other. All
receive the frames in the order of sending: each carries its send time (CLOCK_MONOTONIC, ns).

    can.Bus(interface="local_socket", channel="bench1")

`channel` is the path of the folder, or a name that becomes a folder below $XDG_RUNTIME_DIR.
"""

from __future__ import annotations

import errno
import os
import secrets
import select
import socket
import stat
import struct
import sys
import tempfile
import time
from collections import deque
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import Any

import can

from drivers.base.clocks import WallOffset

FRAME = struct.Struct("=IB3x8s")
"""`struct can_frame` of Linux: identifier with flags, length, eight bytes."""

EXTENDED, REMOTE, ERROR = 0x80000000, 0x40000000, 0x20000000
"""Flags of an identifier, as Linux has them."""

_STAMP = 8
_WIRE = FRAME.size + _STAMP
"""Bytes of a frame and its time stamp."""

MAX_PATH_LENGTH = 100
"""Maximum length of a socket path in bytes; Linux accepts 107."""

_DOWN = "down"
_SETTLED = 50_000_000
"""Time after a folder's last change from which its modification time shows every further change (ns)."""
_BACKLOG = 64


class LocalSocketBus(can.BusABC):
    """One participant of a local bus; classic frames only.

    `overruns` counts frames dropped because a receiver's queue was full.
    """

    def __init__(
        self,
        channel: str | os.PathLike[str] = "can0",
        can_filters: Any = None,
        receive_own_messages: bool = False,
        **others: object,
    ) -> None:
        """Join the bus of `channel`; `others` (bit rate and the like) are ignored.

        Raises:
            can.CanInitializationError: the folder cannot be created, does not belong to this user alone, or
                its path is too long.
        """
        self.overruns = 0
        self.folder = folder_of(channel)
        self.channel_info = f"local_socket {self.folder}"
        self._own = receive_own_messages
        self._wall = WallOffset()
        self._name = f"{os.getpid()}-{secrets.token_hex(4)}.sock"
        self._peers: dict[str, socket.socket] = {}
        self._down = False
        self._listed = -1
        self._waiting: deque[bytes] = deque()
        self._filter: list[tuple[int, int]] = []
        self._folder = str(self.folder)
        path, made = self.folder / self._name, self.folder / f".{self._name}"
        if len(os.fsencode(made)) > MAX_PATH_LENGTH:
            raise can.CanInitializationError(
                f"local_socket: {made} is longer than {MAX_PATH_LENGTH} bytes; choose a shorter channel"
            )
        try:
            make_folder(self.folder)
            self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
            self._listener.bind(str(made))
            self._listener.listen(_BACKLOG)
            made.rename(path)  # only now: others must not find a socket that does not listen yet
        except OSError as error:
            raise can.CanInitializationError(f"local_socket: {self.folder}: {error}", error.errno) from error
        self._readable = [self._listener]
        super().__init__(channel=str(channel), can_filters=can_filters)
        self._look()

    # Raw frames ----------------------------------------------------------------------------------

    def send_frame(self, frame: bytes) -> float:
        """Send `frame` (FRAME) to all others without blocking; return the send time (s, CLOCK_MONOTONIC).

        Raises:
            OSError: ENETDOWN when the bus is switched off.
        """
        if self._listed != os.stat(self._folder).st_mtime_ns:
            self._look()
        if self._down:
            raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))
        now = time.monotonic_ns()
        stamped = frame + now.to_bytes(_STAMP, "big")
        for name, peer in list(self._peers.items()):
            try:
                peer.send(stamped)
            except BlockingIOError:
                self.overruns += 1
            except OSError:  # it disconnected
                self._peers.pop(name).close()
        if self._own:
            self._waiting.append(stamped)
        return 1e-9 * now

    def receive_frame(self, timeout: float | None) -> bytes | None:
        """Return the next frame (FRAME) that passes the filters, or None after `timeout` s."""
        stamped = self._next(timeout)
        return None if stamped is None else stamped[: FRAME.size]

    def sync_time(self, sent: float) -> float:
        """Return `sent`: frames are delivered without delay."""
        return sent

    def _next(self, timeout: float | None) -> bytes | None:
        """Return the next frame with its time stamp, or None after `timeout` s."""
        waiting, begin = self._waiting, time.monotonic() if timeout else 0.0
        left = timeout
        while not waiting:
            ready = select.select(self._readable, (), (), left)[0]
            if not ready:
                return None
            if self._listener in ready:
                self._admit()
                ready.remove(self._listener)
            if len(ready) == 1:
                if stamped := self._take(ready[0]):
                    waiting.append(stamped)
            elif ready:
                self._merge(ready)
            if timeout:
                left = max(0.0, timeout - (time.monotonic() - begin))
        return waiting.popleft()

    def _take(self, peer: socket.socket) -> bytes | None:
        """Return the next stamped frame of `peer`: None if none is queued, empty if filtered out."""
        try:
            stamped = peer.recv(_WIRE)
        except BlockingIOError:
            return None
        except OSError:
            stamped = b""
        if not stamped:  # it disconnected
            self._readable.remove(peer)
            peer.close()
            return None
        return stamped if len(stamped) == _WIRE and self._passes(stamped) else b""

    def _merge(self, peers: list[socket.socket]) -> None:
        """Queue everything received from `peers` in the order of sending."""
        taken: list[bytes] = []
        for peer in peers:
            while (stamped := self._take(peer)) is not None:
                taken.append(stamped)
        taken.sort(key=itemgetter(slice(FRAME.size, None)))
        self._waiting += filter(None, taken)

    def _passes(self, frame: bytes) -> bool:
        """Whether `frame` passes the filters; error frames always do, as in the kernel."""
        if not self._filter:
            return True
        identifier = int.from_bytes(frame[:4], sys.byteorder)
        return bool(identifier & ERROR) or any(identifier & mask == wanted for wanted, mask in self._filter)

    def _admit(self) -> None:
        with suppress(BlockingIOError):
            while True:
                peer, _ = self._listener.accept()
                peer.setblocking(False)
                self._readable.append(peer)

    def _look(self) -> None:
        """Connect to new participants and update whether the bus is switched on."""
        changed = os.stat(self._folder).st_mtime_ns
        names = os.listdir(self._folder)
        self._down = _DOWN in names
        for name in names:
            if name.endswith(".sock") and name[0] != "." and name != self._name and name not in self._peers:
                self._connect(name)
        # A change within one step of the file system's clock is invisible: rescan until the folder settles.
        # A change in the future was made before the clock was set back.
        self._listed = changed if abs(time.time_ns() - changed) > _SETTLED else -1

    def _connect(self, name: str) -> None:
        peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            peer.connect(f"{self._folder}/{name}")
            self._peers[name] = peer
        except ConnectionRefusedError:  # left over from a killed process
            peer.close()
            with suppress(OSError):
                os.unlink(f"{self._folder}/{name}")
        except OSError:
            peer.close()

    # python-can ----------------------------------------------------------------------------------

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send `msg` to all others.

        Raises:
            can.CanOperationError: the bus is switched off, or `msg` is a CAN FD frame.
        """
        if msg.is_fd:
            raise can.CanOperationError("local_socket: classic frames only")
        flags = msg.is_extended_id * EXTENDED | msg.is_remote_frame * REMOTE | msg.is_error_frame * ERROR
        try:
            self.send_frame(FRAME.pack(msg.arbitration_id | flags, msg.dlc, bytes(msg.data)))
        except OSError as error:
            raise can.CanOperationError(f"Failed to transmit: {error.strerror}", error.errno) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        stamped = self._next(timeout)
        if stamped is None:
            return None, True
        sent = int.from_bytes(stamped[FRAME.size :], "big") + self._wall.read()
        return message_of(stamped[: FRAME.size], self.channel_info, 1e-9 * sent), True

    def _apply_filters(self, filters: Any) -> None:
        chosen = []
        for one in filters or ():
            identifier, mask = one["can_id"], one["can_mask"]
            if "extended" in one:
                identifier, mask = identifier | one["extended"] * EXTENDED, mask | EXTENDED
            chosen.append((identifier & mask, mask))
        self._filter = chosen

    def shutdown(self) -> None:
        """Leave the bus. May be called twice."""
        super().shutdown()
        with suppress(OSError):
            os.unlink(f"{self._folder}/{self._name}")
        for one in (*self._readable, *self._peers.values()):
            one.close()
        self._peers.clear()
        self._readable.clear()


def message_of(frame: bytes, channel: str, timestamp: float = 0.0) -> can.Message:
    """Return `frame` (FRAME) as a python-can message; `timestamp` is in s of time.time."""
    identifier, length, data = FRAME.unpack(frame)
    return can.Message(
        timestamp=timestamp,
        arbitration_id=identifier & (0x1FFFFFFF if identifier & EXTENDED else 0x7FF),
        is_extended_id=bool(identifier & EXTENDED),
        is_remote_frame=bool(identifier & REMOTE),
        is_error_frame=bool(identifier & ERROR),
        dlc=min(length, 8),
        data=None if identifier & REMOTE else data[: min(length, 8)],
        channel=channel,
    )


def folder_of(channel: str | os.PathLike[str]) -> Path:
    """Return the folder of a bus: `channel` itself if it is a path, else a runtime folder of that name."""
    path = Path(channel)
    if len(path.parts) != 1:
        return path
    above = os.environ.get("XDG_RUNTIME_DIR") or f"{tempfile.gettempdir()}"
    return Path(above) / f"golfbench-can-{os.getuid()}-{channel}"


def make_folder(folder: Path) -> None:
    """Create `folder`, or check that the existing one belongs to this user alone.

    Raises:
        OSError: it cannot be created, or others may write to it: they could command the robot.
    """
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise PermissionError(errno.EPERM, "not a folder that this user alone may write to", str(folder))


def switch(channel: str | os.PathLike[str], *, on: bool) -> None:
    """Switch the bus of `channel` on or off, as `ip link set can0 up` or `down`; off makes sending fail."""
    mark = folder_of(channel) / _DOWN
    if on:
        mark.unlink(missing_ok=True)
    else:
        mark.touch()
