"""Commands of the page, each a method of `BenchClient`: sent once, from the state on the screen.

A lease belongs to the browser tab that took it, by a secret ticket. The tab renews it while it is open and
connected. A tablet that is switched off or out of reach lets it expire, and an armed bench disarms.
"""

from __future__ import annotations

import secrets
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from threading import Lock
from typing import NamedTuple

from bench.base.errors import Refused
from bench.network.bench_service import CommandAnswer
from bench.network.client import BenchClient

TIMEOUT = 2.0
"""Time for which a command is retried while the bench refuses it for a passing reason, s.

Shorter than at the command line, which waits in front of the operator: nothing may move long after a click.
"""
MAX_AGE = 3.0
"""Max age of the state that a command was given from, s."""
MAX_NUMBERS = 1024
"""Number of commands that are remembered to refuse their repetition."""


class PageCommand(NamedTuple):
    """One command."""

    send: Callable[[BenchClient], CommandAnswer]
    leased: bool
    """Whether it needs the lease."""


COMMANDS: Mapping[str, PageCommand] = {
    "reset": PageCommand(lambda bench: bench.reset(TIMEOUT), True),
    "home": PageCommand(lambda bench: bench.home(TIMEOUT), True),
    "arm": PageCommand(lambda bench: bench.arm(TIMEOUT), True),
    "disarm": PageCommand(lambda bench: bench.disarm(), False),
    "swing": PageCommand(lambda bench: bench.swing(TIMEOUT), True),
    "tee": PageCommand(lambda bench: bench.tee(), True),
    "access": PageCommand(lambda bench: bench.access(), True),
    "secure": PageCommand(lambda bench: bench.secure(), True),
}
"""Commands by name, without the stops."""

STOPS: Mapping[str, Callable[[BenchClient], CommandAnswer]] = {
    "stop": lambda bench: bench.stop(),
    "estop": lambda bench: bench.emergency_stop(),
}


class CommandNumbers:
    """Numbers of received commands, so that one that arrives twice or late is refused.

    A browser or a proxy may send a request again after a lost connection, and a slow network may deliver it
    late: neither may move the robot.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen: OrderedDict[str, None] = OrderedDict()
        self._lock = Lock()

    def check(self, number: str, seen: float | None) -> None:
        """Take command `number`, given from the state of time `seen` (s, the page's clock); None: any.

        Raises:
            Refused: it came before, or the state on the screen was too old.
        """
        with self._lock:
            if number in self._seen:
                raise Refused(
                    "command", "received twice", "each click once", "Look at the state, then click."
                )
            self._seen[number] = None
            while len(self._seen) > MAX_NUMBERS:
                self._seen.popitem(last=False)
        if seen is None:
            return
        age = self._clock() - seen
        if not 0.0 <= age <= MAX_AGE:
            raise Refused(
                "command",
                f"given from a state that is {age:.0f} s old" if age > 0 else "given from an unknown state",
                f"a state of the last {MAX_AGE:g} s",
                "Wait until the page shows the present state, then click again.",
            )


LEASE = 15.0
"""Duration of a lease from each renewal, s."""
MAX_TICKETS = 16
"""Max number of tickets; the bench gives out one lease at a time, older tickets are of lost leases."""


class PageLease(NamedTuple):
    """A lease of one tab."""

    ticket: str
    holder: str
    seconds: float
    """Duration from each renewal, s."""


class _Held(NamedTuple):
    client: BenchClient
    until: float


class PageLeases:
    """The leases by ticket."""

    def __init__(
        self, connect: Callable[[], BenchClient], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`connect` returns a new client without a lease."""
        self._connect, self._clock = connect, clock
        self._held: dict[str, _Held] = {}
        self._lock = Lock()

    def take(self, holder: str) -> PageLease:
        """Take the bench's lease for `holder`; raises as `BenchClient.take_lease`."""
        client = self._connect()
        client.take_lease(holder, LEASE)
        ticket = secrets.token_urlsafe(24)
        with self._lock:
            now = self._clock()
            self._held = {t: held for t, held in self._held.items() if held.until > now}
            while len(self._held) >= MAX_TICKETS:
                del self._held[next(iter(self._held))]
            self._held[ticket] = _Held(client, now + LEASE)
        return PageLease(ticket, holder, LEASE)

    def renew(self, ticket: str) -> float:
        """Renew the lease for LEASE from now; return its seconds. Raises as `BenchClient.renew_lease`."""
        client = self.client(ticket)
        try:
            seconds = client.renew_lease()
        except Refused:
            self._forget(ticket)
            raise
        with self._lock:
            if ticket in self._held:
                self._held[ticket] = _Held(client, self._clock() + seconds)
        return seconds

    def release(self, ticket: str) -> dict[str, float]:
        """Release the lease; an armed bench disarms. Return its seconds: 0."""
        client = self.client(ticket)
        self._forget(ticket)
        client.release_lease()
        return {"seconds": 0.0}

    def client(self, ticket: str) -> BenchClient:
        """Return the client that holds the lease of `ticket`.

        Raises:
            Refused: no lease, or it has expired.
        """
        with self._lock:
            held = self._held.get(ticket)
        if held is None or self._clock() > held.until:
            raise Refused("lease", "not held by this page", "the lease of the bench", "Take the lease first.")
        return held.client

    def _forget(self, ticket: str) -> None:
        with self._lock:
            self._held.pop(ticket, None)
