"""TCP server for launch monitors, in the role of GSPro in Open Connect.

One thread serves all connections. Every message is answered and counted; records are queued until taken. A
monitor that does not read its answers, sends an endless object or falls silent is disconnected and may
reconnect.
"""

from __future__ import annotations

import asyncio
import socket
import threading
import time as wall
from collections import deque
from collections.abc import Callable, Sequence
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


class _Client(NamedTuple):
    """A connection."""

    writer: asyncio.StreamWriter
    address: str
    conversation: Conversation


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
        self._clients: list[_Client] = []
        self._counts = MessageCounts()
        self._connections = self._rejected = self._disconnected = self._failures = self._lost = 0
        self._player = b""
        self._listener: socket.socket | None = None
        self._thread: threading.Thread | None = None

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
        runner = asyncio.Runner(loop_factory=asyncio.new_event_loop)
        self._listener, self._events, self._stop = listener, runner.get_loop(), asyncio.Event()
        self._room = asyncio.Semaphore(MAX_CONNECTIONS)
        self._thread = threading.Thread(
            target=self._run, args=(runner, listener), name="launch monitor server", daemon=True
        )
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
            for client in self._clients:
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
        if self._thread is not None:
            with suppress(RuntimeError):  # the thread has failed and closed its loop
                self._events.call_soon_threadsafe(self._greet, tuple(self._clients))

    def close(self) -> None:
        """End the round at all monitors, close all connections and stop the thread.

        Allowed in any state, also twice.
        """
        thread, self._thread = self._thread, None
        if thread is not None:
            with suppress(RuntimeError):  # the thread has failed and closed its loop
                self._events.call_soon_threadsafe(self._stop.set)
            thread.join()

    # In the thread -------------------------------------------------------------------------------

    def _run(self, runner: asyncio.Runner, listener: socket.socket) -> None:
        with runner:
            runner.run(self._serve(listener))

    async def _serve(self, listener: socket.socket) -> None:
        server = await asyncio.start_server(self._attend, sock=listener)
        try:
            while not self._stop.is_set():
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._stop.wait(), _CHECK)
                self._check_silence()
        finally:
            self._listener = None
            server.close()
        for client in self._clients:
            client.writer.write(write_ended() if self._player else b"")
            if client.writer.transport.get_write_buffer_size():  # it does not read
                client.writer.transport.abort()
            client.writer.close()
        while len(asyncio.all_tasks()) > 1:  # also connections that wait for room, or were just accepted
            await asyncio.sleep(0.001)

    async def _attend(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection until it ends; an error closes this connection only."""
        address = writer.get_extra_info("peername")[0]
        if not self.settings.accepts(address.split("%")[0]):
            self._reject(writer, f"connection from {address}: not in launch_monitor.clients")
            return
        try:
            await asyncio.wait_for(self._room.acquire(), _CHECK)
        except TimeoutError:
            self._reject(writer, f"connection from {address}: {MAX_CONNECTIONS} are connected")
            return
        if self._stop.is_set():  # nothing closes a client that comes now
            writer.transport.abort()
            self._room.release()
            return
        _end_if_unreachable(writer.get_extra_info("socket"), self.settings.silence)
        client = _Client(writer, address, Conversation(self._clock(), self._measured))
        with self._lock:
            self._connections += 1
            self._clients.append(client)
        if self._player and self.settings.presence == "connected":  # others await the answer alone
            self._greet((client,))
        try:
            while not writer.is_closing() and (data := await reader.read(_CHUNK)):
                self._receive(client, data)
            writer.close()
            await asyncio.wait_for(writer.wait_closed(), _CHECK)
        except (OSError, TimeoutError):  # the other side disconnected, or does not read
            pass
        except Exception:  # an error here must not affect the other monitors
            self._failures += 1
        finally:
            writer.transport.abort()
            self._forget(client)
            self._room.release()

    def _reject(self, writer: asyncio.StreamWriter, why: str) -> None:
        with self._lock:
            self._rejected += 1
            self._refusal = why
        writer.close()

    def _greet(self, clients: Sequence[_Client]) -> None:
        """Send the player now, and the readiness `_APART` later."""
        for client in clients:
            if client.writer.transport.get_write_buffer_size() > _MAX_UNREAD:
                client.writer.transport.abort()
                continue
            client.writer.write(self._player)
            self._events.call_later(_APART, client.writer.write, write_ready())

    def _receive(self, client: _Client, data: bytes) -> None:
        """Process received bytes and answer them."""
        with self._lock:
            parsed = client.conversation.receive(data, self._clock())
            self._take_asides(client.conversation)
            self._records += parsed.records
            while len(self._records) > MAX_WAITING:
                self._records.popleft()
                self._lost += 1
            client.writer.write(parsed.answer)
            reads = client.writer.transport.get_write_buffer_size() <= _MAX_UNREAD
            self._disconnected += not (reads and parsed.keep_open)
        if not parsed.keep_open:
            client.writer.close()
        if not reads:
            client.writer.transport.abort()

    def _take_asides(self, conversation: Conversation) -> None:
        """Take clubs and refused messages of `conversation`; the lock must be held."""
        for aside in conversation.asides:
            self._asides.append(aside)
            if isinstance(aside, RefusedRecord):
                self._refusal = aside.reason
        conversation.asides.clear()
        if conversation.understood is not None:
            self._understood = max(conversation.understood, self._understood or conversation.understood)

    def _check_silence(self) -> None:
        now = self._clock()
        for client in self._clients:
            with self._lock:
                client.conversation.check(now)
                self._take_asides(client.conversation)
                silent = now - client.conversation.last_received > self.settings.silence
                lost = silent and client.conversation.heartbeats and not client.writer.is_closing()
                self._disconnected += lost
            if lost:
                client.writer.transport.abort()

    def _forget(self, client: _Client) -> None:
        with self._lock:
            self._clients.remove(client)
            client.conversation.end(self._clock())
            self._take_asides(client.conversation)
            self._counts.add(client.conversation.counts)


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
