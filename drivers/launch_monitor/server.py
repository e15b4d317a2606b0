"""TCP server for launch monitors, in the role of GSPro in Open Connect.

One thread serves all connections. Every message is answered and counted; records are queued until taken. A
monitor that does not read its answers, sends an endless object or falls silent is disconnected and may
reconnect.
"""

from __future__ import annotations

import selectors
import socket
import threading
import time as wall
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from ipaddress import ip_address
from typing import NamedTuple

from drivers.base import DriverError
from drivers.launch_monitor.conversation import Conversation, MeasuredClubFields, MessageCounts
from drivers.launch_monitor.open_connect import write_ended, write_player, write_ready
from drivers.launch_monitor.record import ClubRecord, LaunchRecord, RefusedRecord
from drivers.launch_monitor.settings import LaunchMonitorSettings

MAX_CONNECTIONS = 8
MAX_WAITING = 1000
"""Maximum queued records; beyond that the oldest are dropped and counted."""
_CHUNK = 65_536
_MAX_UNREAD = 65_536
"""Maximum bytes of unread answers per monitor."""
_CHECK = 0.25
"""Period of the silence check, s."""
_APART = 0.2
"""Minimum time between player and readiness, s: several monitors take what one read returns for one object
and ignore both if they come together."""


class Connected(NamedTuple):
    """A connected monitor."""

    address: str
    device: str
    """Device name; empty before its first message."""
    silent: float
    """Time since its last byte, s."""
    ready: bool | None
    ball_detected: bool | None


class Link(NamedTuple):
    """Status of the server."""

    connected: tuple[Connected, ...]
    counts: MessageCounts
    """Message counts of all connections so far."""
    connections: int
    """Accepted connections so far."""
    rejected: int
    """Rejected connections: not allowed, or too many at once."""
    disconnected: int
    """Connections closed by the server: silent, not reading, or sending an endless object."""
    failures: int
    """Internal errors; each closed its connection."""
    lost: int
    """Records dropped because the queue was full."""
    understood: float | None
    """Time of the last message that was not refused, s; None before the first."""
    refusal: str
    """Newest reason of a refused message or connection; empty without one."""


class _Client:
    """A connection."""

    def __init__(self, connection: socket.socket, address: str, conversation: Conversation) -> None:
        self.connection, self.address, self.conversation = connection, address, conversation
        self.unread = bytearray()
        self.closing = False
        """Whether to close after the last answer is sent."""
        self.ready_at: float | None = None
        """When to send the readiness that follows the player, s (CLOCK_MONOTONIC); None if sent."""

    def greet(self, player: bytes) -> None:
        """Queue the message of the player now, and that of readiness for `_APART` later."""
        self.unread += player
        self.ready_at = wall.monotonic() + _APART


class LaunchMonitorServer:
    """Server for launch monitors; `take`, `link` and `announce_player` may be called from any thread."""

    def __init__(
        self,
        settings: LaunchMonitorSettings,
        *,
        port: int | None = None,
        clock: Callable[[], float] = wall.monotonic,
    ) -> None:
        """Create a server; `port` replaces that of the settings, 0 chooses a free one."""
        self.settings = settings
        self._port = settings.port if port is None else port
        self._clock = clock
        self._lock = threading.Lock()
        self._records: deque[LaunchRecord] = deque()
        self._asides: deque[ClubRecord | RefusedRecord] = deque(maxlen=MAX_WAITING)
        self._measured = MeasuredClubFields()
        self._understood: float | None = None
        self._refusal = ""
        self._clients: dict[int, _Client] = {}
        self._counts = MessageCounts()
        self._connections = self._rejected = self._disconnected = self._failures = self._lost = 0
        self._player = b""
        self._listener: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._stopping = False

    # From outside --------------------------------------------------------------------------------

    def open(self) -> None:
        """Listen and serve.

        Raises:
            DriverError: already open, or the address is unavailable.
        """
        if self._thread is not None:
            raise DriverError("launch monitor server: open() while already open; call close() first")
        family = socket.AF_INET6 if ip_address(self.settings.address).version == 6 else socket.AF_INET
        listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((self.settings.address, self._port))
            listener.listen(MAX_CONNECTIONS)
            listener.setblocking(False)
        except OSError as error:
            listener.close()
            raise DriverError(
                f"launch monitor server: cannot listen at {self.settings.address} port {self._port}: "
                f"{error.strerror or error}; stop the program that uses the port or change "
                "launch_monitor.address or launch_monitor.port (below 1024 needs a privilege)"
            ) from error
        self._wake_out, self._wake_in = socket.socketpair()
        self._wake_in.setblocking(False)
        self._wake_out.setblocking(False)
        self._listener, self._stopping = listener, False
        self._thread = threading.Thread(target=self._serve, name="launch monitor server", daemon=True)
        self._thread.start()

    @property
    def address(self) -> tuple[str, int]:
        """Address and port it listens at.

        Raises:
            DriverError: not open.
        """
        if self._listener is None:
            raise DriverError("launch monitor server: address of a closed server; call open() first")
        host, port = self._listener.getsockname()[:2]
        return host, port

    def take(self) -> list[LaunchRecord]:
        """Return the records received since the last call, in order."""
        with self._lock:
            taken = list(self._records)
            self._records.clear()
        return taken

    def take_asides(self) -> list[ClubRecord | RefusedRecord]:
        """Return the clubs without a ball and the refused messages since the last call, in order."""
        with self._lock:
            taken = list(self._asides)
            self._asides.clear()
        return taken

    def link(self) -> Link:
        """Return the status of the connections."""
        with self._lock:
            now = self._clock()
            counts = replace(self._counts)
            connected = []
            for client in self._clients.values():
                talk = client.conversation
                counts.add(talk.counts)
                silent = max(0.0, now - talk.last_received)
                connected.append(
                    Connected(client.address, talk.device, silent, talk.ready, talk.ball_detected)
                )
            return Link(
                tuple(connected),
                counts,
                self._connections,
                self._rejected,
                self._disconnected,
                self._failures,
                self._lost,
                self._understood,
                self._refusal,
            )

    def announce_player(self, club: str) -> None:
        """Send player and readiness to all connected and later monitors: several do not arm before.

        `club` is a code (DR, W3, H4, I7, PW, PT ...). Call it again whenever shots are awaited, as when the
        bench is armed.
        """
        with self._lock:
            self._player = write_player(club)
            for client in self._clients.values():
                client.greet(self._player)
        self._wake()

    def close(self) -> None:
        """End the round at all monitors, close all connections and stop the thread.

        Allowed in any state, also twice.
        """
        thread, self._thread = self._thread, None
        if thread is None:
            return
        with self._lock:
            for client in self._clients.values():
                client.unread += write_ended() if self._player else b""
        self._stopping = True
        self._wake()
        thread.join()
        self._wake_in.close()
        self._wake_out.close()

    def _wake(self) -> None:
        if self._listener is not None:
            with suppress(OSError):  # full: already awake
                self._wake_out.send(b"!")

    # In the thread -------------------------------------------------------------------------------

    def _serve(self) -> None:
        listener = self._listener
        if listener is None:
            return
        with selectors.DefaultSelector() as selector:
            selector.register(listener, selectors.EVENT_READ)
            selector.register(self._wake_in, selectors.EVENT_READ)
            checked = self._clock()
            try:
                while not self._stopping:
                    for key, events in selector.select(_CHECK):
                        if key.fileobj is listener:
                            self._accept(selector, listener)
                        elif key.fileobj is self._wake_in:
                            with suppress(OSError):
                                self._wake_in.recv(_CHUNK)
                            for client in list(self._clients.values()):
                                self._attend(selector, client, selectors.EVENT_WRITE)
                        else:
                            self._attend(selector, key.data, events)
                    self._send_ready(selector)
                    if self._clock() - checked >= _CHECK:
                        checked = self._clock()
                        self._check_silence(selector)
            finally:
                for client in list(self._clients.values()):
                    with self._lock, suppress(OSError):
                        client.connection.send(client.unread)
                    self._drop(selector, client)
                self._listener = None
                listener.close()

    def _accept(self, selector: selectors.BaseSelector, listener: socket.socket) -> None:
        try:
            connection, peer = listener.accept()
        except OSError:  # disconnected already, or no file descriptors left
            wall.sleep(0.01)
            return
        full = len(self._clients) >= MAX_CONNECTIONS
        if full or not self.settings.accepts(peer[0].split("%")[0]):
            why = f"{MAX_CONNECTIONS} are connected" if full else "not in launch_monitor.clients"
            with self._lock:
                self._rejected += 1
                self._refusal = f"connection from {peer[0]}: {why}"
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        _end_if_unreachable(connection, self.settings.silence)
        client = _Client(connection, peer[0], Conversation(self._clock(), self._measured))
        with self._lock:
            self._connections += 1
            self._clients[id(client)] = client
            if self._player and self.settings.presence == "connected":  # others await the answer alone
                client.greet(self._player)
        selector.register(connection, selectors.EVENT_READ, client)
        self._attend(selector, client, selectors.EVENT_WRITE)

    def _attend(self, selector: selectors.BaseSelector, client: _Client, events: int) -> None:
        """Read from and write to `client`; an error closes this connection only."""
        try:
            connected = True
            if events & selectors.EVENT_READ and not client.closing:
                connected = self._receive(client)
            if connected:
                connected = self._answer(selector, client)
        except OSError:  # the other side disconnected
            connected = False
        except Exception:  # an error here must not affect the other monitors
            self._failures += 1
            connected = False
        if not connected:
            self._drop(selector, client)

    def _receive(self, client: _Client) -> bool:
        """Process received bytes; return whether the connection is still open."""
        try:
            data = client.connection.recv(_CHUNK)
        except BlockingIOError:
            return True
        if not data:
            return False
        with self._lock:
            parsed = client.conversation.receive(data, self._clock())
            self._take_asides(client.conversation)
            self._records += parsed.records
            while len(self._records) > MAX_WAITING:
                self._records.popleft()
                self._lost += 1
            client.unread += parsed.answer
            client.closing = not parsed.keep_open
            if client.closing:
                self._disconnected += 1
        return True

    def _take_asides(self, conversation: Conversation) -> None:
        """Take clubs and refused messages of `conversation`; the lock must be held."""
        for aside in conversation.asides:
            self._asides.append(aside)
            if isinstance(aside, RefusedRecord):
                self._refusal = aside.reason
        conversation.asides.clear()
        if conversation.understood is not None:
            self._understood = max(conversation.understood, self._understood or conversation.understood)

    def _answer(self, selector: selectors.BaseSelector, client: _Client) -> bool:
        """Send queued answers; return whether the connection is still open."""
        with self._lock:
            if client.unread:
                with suppress(BlockingIOError):
                    del client.unread[: client.connection.send(client.unread)]
            left = len(client.unread)
            if left > _MAX_UNREAD:
                self._disconnected += 1
        if left > _MAX_UNREAD or (client.closing and not left):
            return False
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if left else 0)
        selector.modify(client.connection, wanted, client)
        return True

    def _send_ready(self, selector: selectors.BaseSelector) -> None:
        """Send the readiness to the monitors that got the player before."""
        now = wall.monotonic()
        for client in list(self._clients.values()):
            with self._lock:
                due = client.ready_at is not None and now >= client.ready_at
                if due:
                    client.unread += write_ready()
                    client.ready_at = None
            if due:
                self._attend(selector, client, selectors.EVENT_WRITE)

    def _check_silence(self, selector: selectors.BaseSelector) -> None:
        now = self._clock()
        for client in list(self._clients.values()):
            with self._lock:
                client.conversation.check(now)
                self._take_asides(client.conversation)
                silent = now - client.conversation.last_received > self.settings.silence
            if client.closing or (silent and client.conversation.heartbeats):
                self._disconnected += not client.closing
                self._drop(selector, client)

    def _drop(self, selector: selectors.BaseSelector, client: _Client) -> None:
        with self._lock:
            if self._clients.pop(id(client), None) is None:
                return  # already dropped in this round
            client.conversation.end(self._clock())
            self._take_asides(client.conversation)
            self._counts.add(client.conversation.counts)
        with suppress(KeyError, ValueError):
            selector.unregister(client.connection)
        client.connection.close()


def _end_if_unreachable(connection: socket.socket, timeout: float) -> None:
    """Let the system end `connection` if the other machine does not respond for `timeout` (s)."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    values = {
        "TCP_KEEPIDLE": max(1, round(timeout / 2)),
        "TCP_KEEPINTVL": max(1, round(timeout / 6)),
        "TCP_USER_TIMEOUT": round(1e3 * timeout),
    }
    for name, value in values.items():
        if hasattr(socket, name):  # not on every system
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
