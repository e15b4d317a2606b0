"""The TCP server a launch monitor connects to: GSPro's place in Open Connect.

One thread serves all connections. Whatever comes, it is answered, counted and survived; records wait until
they are taken. A monitor that does not read its answers, sends without end or falls silent is let go and may
come again.
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
from drivers.launch_monitor.conversation import Conversation, MessageCounts
from drivers.launch_monitor.open_connect import write_player
from drivers.launch_monitor.record import LaunchRecord
from drivers.launch_monitor.settings import LaunchMonitorSettings

MOST_CONNECTIONS = 8
MOST_WAITING = 1000
"""Records that wait to be taken; beyond that the oldest are lost and counted."""
_CHUNK = 65_536
_MOST_UNREAD = 65_536
"""Bytes of answers that wait for a monitor to read them."""
_CHECK = 0.25
"""s between two looks at silence."""


class Connected(NamedTuple):
    """A monitor that is connected."""

    address: str
    device: str
    """As it calls itself; empty before its first message."""
    silent: float
    """s since its last byte."""
    ready: bool | None
    ball_detected: bool | None


class Link(NamedTuple):
    """How the server does."""

    connected: tuple[Connected, ...]
    counts: MessageCounts
    """Of all connections so far."""
    connections: int
    """So far, refused ones not among them."""
    turned_away: int
    """Not allowed, or too many at once."""
    let_go: int
    """Ended by us: silent, not reading, or sending without end."""
    failures: int
    """Mistakes of this server; the connection they happened on was closed."""
    lost: int
    """Records that nobody took in time."""


class _Client:
    """A connection."""

    def __init__(self, connection: socket.socket, address: str, conversation: Conversation) -> None:
        self.connection, self.address, self.conversation = connection, address, conversation
        self.unread = bytearray()
        self.closing = False
        """Its last answer is on the way."""


class LaunchMonitorServer:
    """See the module's text. `take`, `link` and `tell_player` may be called from any thread."""

    def __init__(
        self,
        settings: LaunchMonitorSettings,
        *,
        port: int | None = None,
        clock: Callable[[], float] = wall.monotonic,
    ) -> None:
        """`port` replaces that of the settings; 0 lets the system choose one."""
        self.settings = settings
        self._port = settings.port if port is None else port
        self._clock = clock
        self._lock = threading.Lock()
        self._records: deque[LaunchRecord] = deque()
        self._clients: dict[int, _Client] = {}
        self._counts = MessageCounts()
        self._connections = self._turned_away = self._let_go = self._failures = self._lost = 0
        self._player = b""
        self._listener: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._stopping = False

    # From outside --------------------------------------------------------------------------------

    def open(self) -> None:
        """Listen and serve.

        Raises:
            DriverError: it is open already, or the address cannot be had.
        """
        if self._thread is not None:
            raise DriverError("launch monitor server: open() found it open already; call close() first")
        family = socket.AF_INET6 if ip_address(self.settings.address).version == 6 else socket.AF_INET
        listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((self.settings.address, self._port))
            listener.listen(MOST_CONNECTIONS)
            listener.setblocking(False)
        except OSError as error:
            listener.close()
            raise DriverError(
                f"launch monitor server: found {error.strerror or error} at {self.settings.address} port "
                f"{self._port}, expected to listen there; end what else listens there or change "
                "launch_monitor.address or launch_monitor.port (below 1024 takes a privilege)"
            ) from error
        self._wake_out, self._wake_in = socket.socketpair()
        self._wake_in.setblocking(False)
        self._wake_out.setblocking(False)
        self._listener, self._stopping = listener, False
        self._thread = threading.Thread(target=self._serve, name="launch monitor server", daemon=True)
        self._thread.start()

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens.

        Raises:
            DriverError: it does not.
        """
        if self._listener is None:
            raise DriverError("launch monitor server: found it closed, expected it open; call open() first")
        host, port = self._listener.getsockname()[:2]
        return host, port

    def take(self) -> list[LaunchRecord]:
        """Return the records that came since the last call, in the order they came."""
        with self._lock:
            taken = list(self._records)
            self._records.clear()
        return taken

    def link(self) -> Link:
        """Return how the connections are."""
        with self._lock:
            now = self._clock()
            counts = replace(self._counts)
            connected = []
            for client in self._clients.values():
                talk = client.conversation
                counts.add(talk.counts)
                silent = max(0.0, now - talk.heard)
                connected.append(
                    Connected(client.address, talk.device, silent, talk.ready, talk.ball_detected)
                )
            return Link(
                tuple(connected),
                counts,
                self._connections,
                self._turned_away,
                self._let_go,
                self._failures,
                self._lost,
            )

    def tell_player(self, club: str, handed: str = "RH") -> None:
        """Tell all monitors, and those to come, which club is played: DR, W3, H4, I7, PW, PT ..."""
        with self._lock:
            self._player = write_player(club, handed)
            for client in self._clients.values():
                client.unread += self._player
        self._wake()

    def close(self) -> None:
        """End all connections and the thread. Allowed in any state, also twice."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._stopping = True
        self._wake()
        thread.join()
        self._wake_in.close()
        self._wake_out.close()

    def _wake(self) -> None:
        if self._listener is not None:
            with suppress(OSError):  # full: it is awake
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
                    if self._clock() - checked >= _CHECK:
                        checked = self._clock()
                        self._check_silence(selector)
            finally:
                for client in list(self._clients.values()):
                    self._drop(selector, client)
                self._listener = None
                listener.close()

    def _accept(self, selector: selectors.BaseSelector, listener: socket.socket) -> None:
        try:
            connection, peer = listener.accept()
        except OSError:  # it has gone again, or there are no descriptors left
            wall.sleep(0.01)
            return
        if len(self._clients) >= MOST_CONNECTIONS or not self.settings.lets_in(peer[0].split("%")[0]):
            self._turned_away += 1
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        client = _Client(connection, peer[0], Conversation(self.settings.plausible, self._clock()))
        with self._lock:
            self._connections += 1
            self._clients[id(client)] = client
            client.unread += self._player
        selector.register(connection, selectors.EVENT_READ, client)
        self._attend(selector, client, selectors.EVENT_WRITE)

    def _attend(self, selector: selectors.BaseSelector, client: _Client, events: int) -> None:
        """Read from and write to `client`; whatever goes wrong ends this connection and no other."""
        try:
            stays = True
            if events & selectors.EVENT_READ and not client.closing:
                stays = self._hear(client)
            if stays:
                stays = self._answer(selector, client)
        except OSError:  # the other side has gone
            stays = False
        except Exception:  # a mistake here must not take the other monitors along
            self._failures += 1
            stays = False
        if not stays:
            self._drop(selector, client)

    def _hear(self, client: _Client) -> bool:
        """Take what came; tell whether the connection still stands."""
        try:
            data = client.connection.recv(_CHUNK)
        except BlockingIOError:
            return True
        if not data:
            return False
        with self._lock:
            heard = client.conversation.hear(data, self._clock())
            self._records += heard.records
            while len(self._records) > MOST_WAITING:
                self._records.popleft()
                self._lost += 1
            client.unread += heard.answer
            client.closing = not heard.stays
            if client.closing:
                self._let_go += 1
        return True

    def _answer(self, selector: selectors.BaseSelector, client: _Client) -> bool:
        """Send what waits; tell whether the connection still stands."""
        with self._lock:
            if client.unread:
                with suppress(BlockingIOError):
                    del client.unread[: client.connection.send(client.unread)]
            left = len(client.unread)
            if left > _MOST_UNREAD:
                self._let_go += 1
        if left > _MOST_UNREAD or (client.closing and not left):
            return False
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if left else 0)
        selector.modify(client.connection, wanted, client)
        return True

    def _check_silence(self, selector: selectors.BaseSelector) -> None:
        now = self._clock()
        for client in list(self._clients.values()):
            with self._lock:
                client.conversation.check(now)
                silent = now - client.conversation.heard > self.settings.silence
            if client.closing or (silent and client.conversation.heartbeats):
                self._let_go += not client.closing
                self._drop(selector, client)

    def _drop(self, selector: selectors.BaseSelector, client: _Client) -> None:
        with self._lock:
            if self._clients.pop(id(client), None) is None:
                return  # dropped already, in the same round
            client.conversation.end()
            self._counts.add(client.conversation.counts)
        with suppress(KeyError, ValueError):
            selector.unregister(client.connection)
        client.connection.close()
