"""The console's connection to its bench: kept, monitored, and opened again when it is lost."""

from __future__ import annotations

import time
from contextlib import closing
from threading import Event, Thread
from typing import TYPE_CHECKING, Self

from bench.base.errors import BenchError
from bench.base.lifecycle import State, in_one
from bench.network.client import BenchClient
from bench.network.status_words import LATCHED, MOVING, sentence, state_words
from bench.network.zenoh_session import NoAnswer

if TYPE_CHECKING:
    from bench.base.address import BenchAddress
    from bench.network.bench_service import BenchStatus

SILENT = 1.0
"""Time without a state after which the bench counts as silent (s); it publishes every 0.2 s."""
REDRAW = 0.2
"""Period of the state line (s)."""
_RETRY_DELAY = 1.0
"""Time between two attempts to connect (s)."""
STOP_KEYS = "F8 or Ctrl-\\"
_PLAIN, _GREEN, _YELLOW, _RED = "7", "30;42", "30;43", "1;97;41"
"""Attributes of the state line at a terminal; yellow: the robot moves or may move."""


class KeptConnection:
    """One connection to a bench, with its newest state; a context."""

    def __init__(self, address: BenchAddress) -> None:
        self.note = ""
        """Result of the newest stop by key."""
        self._address = address
        self._client: BenchClient | None = None
        self._status: BenchStatus | None = None
        self._received_at = time.monotonic()
        self._error: BenchError | None = None
        """Why there is no connection."""
        self._ended = Event()
        self._thread = Thread(target=self._follow, name="console connection", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(SILENT)
        if self._client is not None:
            self._client.close()

    @property
    def status(self) -> BenchStatus | None:
        """The newest state; None before the first and while the bench is silent."""
        return None if time.monotonic() - self._received_at > SILENT else self._status

    def wait(self, timeout: float) -> None:
        """Wait up to `timeout` (s) for the first state."""
        end = time.monotonic() + timeout
        while self._status is None and time.monotonic() < end:
            time.sleep(0.01)

    def client(self, stopping: bool) -> BenchClient:
        """Return a client without a lease on the connection; not to be closed.

        Raises:
            NoAnswer: there is no connection, or the bench is silent and this is not for `stopping`.
        """
        if self._client is not None and (stopping or self.status is not None):
            return self._client.sibling()
        if self._client is None and self._error is not None:
            raise self._error
        raise NoAnswer(self._address.bench.id, self._address.network.endpoint, self._silence())

    def stop(self) -> None:
        """Stop the robot at once, in a new thread; the state line shows the result."""
        Thread(target=self._stop, args=(time.monotonic(),), name="console stop", daemon=True).start()

    def _stop(self, pressed_at: float) -> None:
        self.note = "STOP sent"
        try:
            self.client(stopping=True).stop()
        except Exception as error:  # whatever failed, the person has to know it
            reason = error.found if isinstance(error, BenchError) else type(error).__name__
            self.note = f"STOP FAILED, use the emergency stop: {reason}"
        else:
            self.note = f"STOP accepted after {1e3 * (time.monotonic() - pressed_at):.0f} ms"

    def line(self, width: int) -> str:
        """Return the state line for a terminal `width` columns wide, with its attributes."""
        text, attributes = self._state()
        parts = f"STOP: {STOP_KEYS}", self.note, f"bench {self._address.bench.id}", text
        shown = f" {'  '.join(filter(None, parts))}"
        return f"\x1b[0;{attributes}m{shown[:width]:<{width}}\x1b[0m"

    def _state(self) -> tuple[str, str]:
        status = self.status
        if status is None:
            before = f", in {self._status['state']} before" if self._status else ""
            return f"NO CONNECTION: {self._silence()}{before}", _RED
        state, lease, cause = State[status["state"]], status["lease"], status["cause"]
        fact = sentence(in_one((cause["text"], cause["action"]))) if cause else state_words(status)
        held = f"lease {lease['holder']} {lease['seconds_left']:.0f} s" if lease else "no lease"
        ball = "" if state is not State.ARMED else "  ball" if status["ball_present"] else "  no ball"
        attributes = _RED if state in LATCHED else _YELLOW if state in MOVING else _GREEN
        return f"{state.name}{ball}  swings {status['swings']}  {held}  {fact}", attributes

    def _silence(self) -> str:
        if self._status is None:
            return self._error.found if self._error else "connecting"
        return f"last state {time.monotonic() - self._received_at:.0f} s ago"

    def _follow(self) -> None:
        """Connect, retry until it succeeds, and receive states; a lost connection is renewed by zenoh."""
        while not self._ended.is_set():
            try:
                if self._client is None:
                    self._client = BenchClient.connect(self._address)
                self._receive(self._client)
            except BenchError as error:
                self._error = error
                self._ended.wait(_RETRY_DELAY)

    def _receive(self, client: BenchClient) -> None:
        with closing(client.states(REDRAW)) as states:
            for received in states:
                if received is not None:
                    self._status, self._received_at = received, time.monotonic()
                if self._ended.is_set():
                    return
