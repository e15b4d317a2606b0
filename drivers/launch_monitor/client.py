"""Passes our shots to GSPro, or to whatever speaks Open Connect as it does.

One thread connects, sends, reads answers and connects again. What GSPro says about club and player is shown
and changes nothing here.
"""

from __future__ import annotations

import socket
import threading
import time as wall
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from drivers.base import DriverError, Launch
from drivers.launch_monitor.objects import ObjectStream
from drivers.launch_monitor.open_connect import SimulatorResponse, read_answer, write_heartbeat, write_shot
from drivers.launch_monitor.record import NO_CLUB, ClubFigures
from drivers.launch_monitor.settings import SimulatorSettings

MOST_WAITING = 16
ANSWER_TIME = 2.0
"""s for connecting and for an answer to a shot; what is not answered is sent once more."""
ATTEMPTS = 2
RECONNECT = 5.0
"""s between two attempts to connect."""
HEARTBEAT = 10.0
"""s without a shot after which a heartbeat goes out."""
_POLL = 0.25
"""s of waiting for answers at a time."""


class Passing(NamedTuple):
    """How passing on does."""

    connected: bool
    trouble: str
    """Why it is not connected, or why the last shot was not taken; empty when all is well."""
    waiting: int
    taken: int
    """Shots that were answered with 200."""
    refused: int
    """Shots that were answered otherwise, or twice not at all."""
    out_of_date: int
    """Shots that waited for too long, or for which there was no room."""
    player: SimulatorResponse | None
    """What the simulator said last about its player."""


class _Waiting(NamedTuple):
    number: int
    message: bytes
    since: float


class SimulatorClient:
    """See the module's text. `send` and `passing` never wait and may be called from any thread."""

    def __init__(
        self,
        settings: SimulatorSettings,
        device: str = "golfbench",
        *,
        clock: Callable[[], float] = wall.monotonic,
        answer_time: float = ANSWER_TIME,
        reconnect: float = RECONNECT,
    ) -> None:
        self.settings, self.device = settings, device
        self._clock, self._answer_time, self._reconnect = clock, answer_time, reconnect
        self._lock = threading.Lock()
        self._news = threading.Event()
        self._stopping = threading.Event()
        self._queue: deque[_Waiting] = deque()
        self._number = 0
        self._connected, self._trouble = False, "not connected yet"
        self._taken = self._refused = self._out_of_date = 0
        self._player: SimulatorResponse | None = None
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Begin to connect; that the simulator is not there is no error but a state.

        Raises:
            DriverError: open already.
        """
        if self._thread is not None:
            raise DriverError("simulator client: open() found it open already; call close() first")
        self._stopping.clear()
        self._thread = threading.Thread(target=self._run, name="simulator client", daemon=True)
        self._thread.start()

    def send(self, launch: Launch, club: ClubFigures = NO_CLUB, carry: float | None = None) -> int:
        """Put a shot (SI) in the queue and return the number it will have.

        Raises:
            ValueError: a figure is not finite.
        """
        with self._lock:
            message = write_shot(self._number + 1, launch, self.device, club, carry)
            self._number += 1
            if len(self._queue) == MOST_WAITING:
                self._queue.popleft()
                self._out_of_date += 1
            self._queue.append(_Waiting(self._number, message, self._clock()))
            number = self._number
        self._news.set()
        return number

    def passing(self) -> Passing:
        """Return how it does."""
        with self._lock:
            return Passing(
                self._connected,
                self._trouble,
                len(self._queue),
                self._taken,
                self._refused,
                self._out_of_date,
                self._player,
            )

    def close(self) -> None:
        """End connection and thread, within the time of an attempt to connect. Allowed in any state."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._stopping.set()
            self._news.set()
            thread.join()

    # In the thread -------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                with socket.create_connection(
                    (self.settings.address, self.settings.port), self._answer_time
                ) as connection:
                    connection.settimeout(_POLL)
                    self._tell(True, "")
                    self._pass_on(connection)
            except OSError as error:
                self._tell(False, f"{self.settings.address} port {self.settings.port}: {error}")
            except Exception as error:  # passing on is a convenience: it never ends by a mistake
                self._tell(False, f"{type(error).__name__}: {error}")
            self._forget_old()
            self._stopping.wait(self._reconnect)
        self._tell(False, "closed")

    def _tell(self, connected: bool, trouble: str) -> None:
        with self._lock:
            self._connected, self._trouble = connected, trouble

    def _forget_old(self) -> None:
        with self._lock:
            oldest = self._clock() - self.settings.longest_wait
            while self._queue and self._queue[0].since < oldest:
                self._queue.popleft()
                self._out_of_date += 1

    def _pass_on(self, connection: socket.socket) -> None:
        """Send what waits until the connection fails (OSError) or the end is asked for."""
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
            self._news.wait(_POLL)
            self._news.clear()

    def _send_shot(self, connection: socket.socket, stream: ObjectStream, shot: _Waiting) -> bool:
        """Send `shot` and wait for its answer; tell whether it was taken."""
        for _ in range(ATTEMPTS):
            connection.sendall(shot.message)
            end = self._clock() + self._answer_time
            while (left := end - self._clock()) > 0.0 and not self._stopping.is_set():
                for answer in self._answers(connection, stream, min(left, _POLL)):
                    if answer.code == 200:
                        self._tell(True, "")
                        return True
                    self._tell(True, f"shot {shot.number} was answered {answer.code}: {answer.text}")
                    return False
        self._tell(True, f"shot {shot.number} was not answered within {self._answer_time:g} s, twice")
        return False

    def _answers(
        self, connection: socket.socket, stream: ObjectStream, timeout: float
    ) -> list[SimulatorResponse]:
        """Return the answers that come within `timeout` (s), news of the player (201 to 203) taken out."""
        connection.settimeout(timeout)
        found: list[SimulatorResponse] = []
        with suppress(TimeoutError):
            data = connection.recv(65_536)
            if not data:
                raise ConnectionError("the simulator has closed the connection")
            objects = stream.feed(data)
            if stream.useless:
                raise ConnectionError(f"the simulator sends {stream.useless}")
            for answer in filter(None, map(read_answer, objects)):
                if 201 <= answer.code <= 299:
                    with self._lock:
                        self._player = answer if answer.code == 201 else self._player
                else:
                    found.append(answer)
        connection.settimeout(self._answer_time)
        return found
