"""Forward shots to GSPro or another Open Connect simulator.

One thread connects, sends, reads answers and reconnects. GSPro's club and player are only displayed.
"""

from __future__ import annotations

import socket
import threading
import time as wall
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

from drivers.base import DriverError, Launch
from drivers.launch_monitor.conversation import ObjectStream
from drivers.launch_monitor.open_connect import SimulatorResponse, read_answer, write_heartbeat, write_shot
from drivers.launch_monitor.record import NO_CLUB, ClubFigures
from drivers.launch_monitor.settings import SimulatorSettings

MAX_WAITING = 16
ANSWER_TIME = 2.0
"""Time-out for connecting and for the answer to a shot, s; an unanswered shot is sent once more."""
ATTEMPTS = 2
RECONNECT = 5.0
"""Time between two connection attempts, s."""
HEARTBEAT = 10.0
"""Time without a shot after which a heartbeat is sent, s."""
MAX_FORWARD_WAIT = 10.0
"""Time after which a shot that could not be forwarded is dropped, s."""
_POLL = 0.25
"""Polling period for answers, s."""


class ForwardingStatus(NamedTuple):
    """Status of the connection to the simulator."""

    connected: bool
    fault: str
    """Why it is not connected or the last shot was not accepted; empty if none."""
    waiting: int
    """Shots in the queue."""
    taken: int
    """Shots answered with 200."""
    refused: int
    """Shots answered with another code, or twice unanswered."""
    out_of_date: int
    """Shots dropped because they waited too long or the queue was full."""
    player: SimulatorResponse | None
    """Last player message of the simulator."""


@dataclass
class _Waiting:
    number: int
    message: bytes
    since: float
    sent: int = 0
    """Times it was sent, over all connections: a simulator may have taken it before it disconnected."""


class SimulatorClient:
    """Connection to a simulator; `send` and `status` never block and may be called from any thread."""

    def __init__(
        self,
        settings: SimulatorSettings,
        device: str = "golfbench",
        *,
        clock: Callable[[], float] = wall.monotonic,
        sync_timeout: float = ANSWER_TIME,
        reconnect: float = RECONNECT,
    ) -> None:
        self.settings, self.device = settings, device
        self._clock, self._answer_time, self._reconnect = clock, sync_timeout, reconnect
        self._lock = threading.Lock()
        self._wakeup = threading.Event()
        self._stopping = threading.Event()
        self._queue: deque[_Waiting] = deque()
        self._number = 0
        self._connected, self._fault = False, "not connected yet"
        self._taken = self._refused = self._out_of_date = 0
        self._player: SimulatorResponse | None = None
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Start connecting; a simulator that does not answer is a state, not an error.

        Raises:
            DriverError: already open.
        """
        if self._thread is not None:
            raise DriverError("simulator client: open() while already open; call close() first")
        self._stopping.clear()
        self._thread = threading.Thread(target=self._run, name="simulator client", daemon=True)
        self._thread.start()

    def send(self, launch: Launch, club: ClubFigures = NO_CLUB, carry: float | None = None) -> int:
        """Queue a shot (SI) and return its number.

        Raises:
            ValueError: a figure is not finite.
        """
        with self._lock:
            message = write_shot(self._number + 1, launch, self.device, club, carry)
            self._number += 1
            if len(self._queue) == MAX_WAITING:
                self._queue.popleft()
                self._out_of_date += 1
            self._queue.append(_Waiting(self._number, message, self._clock()))
            number = self._number
        self._wakeup.set()
        return number

    def status(self) -> ForwardingStatus:
        """Return the status of the connection."""
        with self._lock:
            return ForwardingStatus(
                self._connected,
                self._fault,
                len(self._queue),
                self._taken,
                self._refused,
                self._out_of_date,
                self._player,
            )

    def close(self) -> None:
        """Close connection and thread within one connection time-out. Allowed in any state."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._stopping.set()
            self._wakeup.set()
            thread.join()

    # In the thread -------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                with socket.create_connection(
                    (self.settings.address, self.settings.port), self._answer_time
                ) as connection:
                    connection.settimeout(_POLL)
                    self._set_status(True, "")
                    self._pass_on(connection)
            except OSError as error:
                self._set_status(False, f"{self.settings.address} port {self.settings.port}: {error}")
            except Exception as error:  # forwarding is a convenience and must survive errors
                self._set_status(False, f"{type(error).__name__}: {error}")
            self._forget_old()
            self._stopping.wait(self._reconnect)
        self._set_status(False, "closed")

    def _set_status(self, connected: bool, fault: str) -> None:
        with self._lock:
            self._connected, self._fault = connected, fault

    def _forget_old(self) -> None:
        with self._lock:
            oldest = self._clock() - MAX_FORWARD_WAIT
            while self._queue and self._queue[0].since < oldest:
                self._queue.popleft()
                self._out_of_date += 1

    def _pass_on(self, connection: socket.socket) -> None:
        """Send queued shots until the connection fails (OSError) or a stop is requested."""
        stream, last = ObjectStream(), self._clock()
        while not self._stopping.is_set():
            self._forget_old()
            with self._lock:
                shot = self._queue[0] if self._queue else None
            if shot is not None:
                taken = self._send_shot(connection, stream, shot)
                with self._lock:
                    if self._queue and self._queue[0] is shot:
                        self._queue.popleft()
                    if taken:
                        self._taken += 1
                    else:
                        self._refused += 1
                last = self._clock()
                continue
            if self._clock() - last > HEARTBEAT:
                connection.sendall(write_heartbeat(self._number, self.device))
                last = self._clock()
            self._answers(connection, stream, 0.01)
            self._wakeup.wait(_POLL)
            self._wakeup.clear()

    def _send_shot(self, connection: socket.socket, stream: ObjectStream, shot: _Waiting) -> bool:
        """Send `shot` and wait for its answer; return whether it was accepted."""
        while shot.sent < ATTEMPTS:
            shot.sent += 1
            connection.sendall(shot.message)
            end = self._clock() + self._answer_time
            while (left := end - self._clock()) > 0.0 and not self._stopping.is_set():
                for answer in self._answers(connection, stream, min(left, _POLL)):
                    if answer.code == 200:
                        self._set_status(True, "")
                        return True
                    self._set_status(True, f"shot {shot.number} was answered {answer.code}: {answer.text}")
                    return False
            stream.drop()  # the rest of an answer that was cut off would swallow the next one
        self._set_status(True, f"shot {shot.number} was not answered within {self._answer_time:g} s, twice")
        return False

    def _answers(
        self, connection: socket.socket, stream: ObjectStream, timeout: float
    ) -> list[SimulatorResponse]:
        """Return the answers received within `timeout` (s), without player messages (201 to 299)."""
        connection.settimeout(timeout)
        found: list[SimulatorResponse] = []
        with suppress(TimeoutError):
            data = connection.recv(65_536)
            if not data:
                raise ConnectionError("the simulator has closed the connection")
            objects = stream.feed(data)
            if stream.error:
                raise ConnectionError(f"the simulator sends {stream.error}")
            for answer in filter(None, map(read_answer, objects)):
                if answer.club:
                    with self._lock:
                        self._player = answer
                if not 201 <= answer.code <= 299:
                    found.append(answer)
        connection.settimeout(self._answer_time)
        return found
