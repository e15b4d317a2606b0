"""Requests of the page: lookups and commands, each with the role that it needs.

Commands are methods of `BenchClient`, sent once, from the state on the screen. A lease belongs to the browser
tab that took it, by a secret ticket. The tab renews it while it is open and connected. A tablet that is
switched off or out of reach lets it expire, and an armed bench disarms.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from enum import Enum
from pathlib import Path
from threading import Barrier, Lock
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from bench.base.errors import BenchError, Refused
from bench.network.bench_service import CommandAnswer
from bench.network.client import BenchClient
from bench.network.lease import MAX_HOLDER_LENGTH
from bench.web._answers import (
    Asked,
    Download,
    InvalidBody,
    UnknownName,
    body_of,
    json_answer,
    refusal_answer,
    static_files,
    text_in,
)
from bench.web._bench_link import BenchLink, PageBroadcaster
from bench.web.page_access import SESSION, PageAccess, PageRole

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

T = TypeVar("T")
MAX_DOWNLOADS = 8
PART = 1 << 16
"""Size of a part of a file, bytes."""
TICKET = "golfbench-ticket"
"""Header with the ticket of a lease."""
_GUESS_TIME = 1.0
"""Time that a wrong token costs, one after the other, s."""


class Pool(Enum):
    """Threads for requests of one kind: their name and number."""

    COMMANDS = "command", 8
    LOOKUPS = "lookup", 2
    PROGRAMS = "program", 4
    """Threads that wait for the page's programs."""
    STOPS = "stop", 4
    """Threads for stops only: a stop waits behind nothing."""


class Call(NamedTuple):
    """A request that is answered by JSON."""

    role: PageRole
    """Lowest role of its readers."""
    pool: Pool
    work: Callable[[Asked], Any]
    """Returns the answer; raises UnknownName, InvalidBody, BenchError or a group of them."""
    reads_body: bool = True
    """Whether a POST must have a JSON object as its body."""


class PageService:
    """The page of one bench."""

    def __init__(
        self, link: BenchLink, broadcaster: PageBroadcaster, access: PageAccess, *, secure: bool
    ) -> None:
        """`secure`: reached by TLS."""
        self._link, self._broadcaster, self._access, self._secure = link, broadcaster, access, secure
        self._leases, self._numbers = PageLeases(link.client), CommandNumbers()
        self._files = static_files()
        self._pools = {pool: _started_pool(pool) for pool in Pool}
        self._signing_in = asyncio.Lock()
        self._open = 0
        """Number of downloads under way."""

    def close(self) -> None:
        """End the threads of commands."""
        for pool in self._pools.values():
            pool.shutdown(wait=True, cancel_futures=True)

    @property
    def cookie(self) -> str:
        """Name of the session's cookie."""
        return "__Host-golfbench" if self._secure else "golfbench"

    # Looking -------------------------------------------------------------------------------------

    async def file(self, request: Request) -> Response:
        """Return one of the page's files."""
        from starlette.responses import Response

        found = self._files.get(request.path_params.get("name", "index.html"))
        if found is None:
            return json_answer({"what": "There is no such file."}, 404)
        content, kind = found
        return Response(content, media_type=kind, headers={"cache-control": "no-cache"})

    async def stream(self, request: Request) -> Response:
        """Return server-sent events of the bench; the kernel ends a reader that takes none."""
        from starlette.responses import StreamingResponse

        if (refusal := self.needing(PageRole.VIEWER, request)) is not None:
            return refusal
        if (reader := self._broadcaster.reader()) is None:
            return json_answer({"what": "Too many open pages.", "action": "Close some."}, 503)
        messages = self._broadcaster.messages(reader, self._you(request))
        return StreamingResponse(messages, media_type="text/event-stream")

    async def you(self, request: Request) -> Response:
        """Return the reader's role."""
        return json_answer(self._you(request))

    def _you(self, request: Request) -> dict[str, Any]:
        role = self._role(request)
        return {
            "role": None if role is None else role.name.lower(),
            "sign_in": self._access.tokens,
            "bench": self._link.bench,
        }

    # Signing in ----------------------------------------------------------------------------------

    async def sign_in(self, request: Request) -> Response:
        """Give a session for a token."""
        token = text_in(await body_of(request), "token", 200)
        async with self._signing_in:
            session = self._access.sign_in(token)
            if session is None:
                await asyncio.sleep(_GUESS_TIME)
                return json_answer({"what": "This token is unknown.", "action": "Type it again."}, 401)
        response = json_answer({})
        response.set_cookie(
            self.cookie, session, int(SESSION), httponly=True, samesite="strict", secure=self._secure
        )
        return response

    # Commands ------------------------------------------------------------------------------------

    def stop(self, asked: Asked) -> dict[str, Any]:
        """Stop the robot, whatever the body says; no lease, no number, no age."""
        return _answered(_known(STOPS, asked)(self._link.client()))

    def command(self, asked: Asked) -> dict[str, Any]:
        """Send a command with the lease of the tab that asks."""
        send = _known(COMMANDS, asked)
        asked.once(fresh=True)
        leased = asked.path["name"] not in WITHOUT_LEASE
        return _answered(send(self._leases.client(asked.ticket) if leased else self._link.client()))

    def lease(self, asked: Asked) -> dict[str, Any]:
        """Take, renew or release the lease."""
        match asked.body.get("action"):
            case "take":
                return self._leases.take(asked.text("holder", MAX_HOLDER_LENGTH))
            case "renew":
                return self._leases.renew(asked.ticket)
            case "release":
                return self._leases.release(asked.ticket)
        raise InvalidBody("action: take, renew or release")

    # Helpers -------------------------------------------------------------------------------------

    def calling(self, call: Call) -> Callable[[Request], Awaitable[Response]]:
        """Return the endpoint of `call`."""

        async def answer(request: Request) -> Response:
            if (refusal := self.needing(call.role, request)) is not None:
                return refusal
            body = await body_of(request) if call.reads_body and request.method == "POST" else {}
            ticket = request.headers.get(TICKET, "")
            asked = Asked(request.path_params, body, ticket, self._numbers.check)
            return await self.answered(call.pool, lambda: call.work(asked))

        return answer

    def sending(
        self, find: Callable[[dict[str, str]], Download | None]
    ) -> Callable[[Request], Awaitable[Response]]:
        """Return the endpoint of the file that `find` returns for the names in a path; None: no such file."""

        async def answer(request: Request) -> Response:
            from starlette.responses import StreamingResponse

            if (refusal := self.needing(PageRole.VIEWER, request)) is not None:
                return refusal
            found = await self._looked_up(lambda: find(request.path_params))
            if found is None:
                return json_answer({"what": "There is no such file."}, 404)
            if self._open >= MAX_DOWNLOADS:
                action = "Try again when one has ended."
                return json_answer({"what": "Too many downloads.", "action": action}, 503)
            return StreamingResponse(self._parts(found.path), media_type=found.kind, headers=found.headers)

        return answer

    async def _parts(self, path: Path) -> AsyncIterator[bytes]:
        """Yield the file at `path` in parts, so that a slow reader costs no more than one of them."""
        self._open += 1
        try:
            with path.open("rb") as stream:
                while part := await self._looked_up(lambda: stream.read(PART)):
                    yield part
        finally:
            self._open -= 1

    async def _looked_up(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._pools[Pool.LOOKUPS], work)

    async def answered(self, pool: Pool, work: Callable[[], Any]) -> Response:
        """Return the outcome of `work`, done in `pool`, or why it was refused."""
        try:
            return json_answer(await asyncio.get_running_loop().run_in_executor(self._pools[pool], work))
        except BenchError as error:
            return refusal_answer(error)
        except ExceptionGroup as errors:
            return refusal_answer(_first_of(errors))

    def needing(self, role: PageRole, request: Request) -> Response | None:
        """Return the refusal of a reader with a lower role than `role`; None for others."""
        found = self._role(request)
        if found is None:
            return json_answer({"what": "Not signed in.", "action": "Sign in with a token."}, 401)
        if found < role:
            what = f"Your role does not allow it: {found.name.lower()}, needs {role.name.lower()}."
            return json_answer({"what": what, "action": "Ask the owner of the bench for a role."}, 403)
        return None

    def _role(self, request: Request) -> PageRole | None:
        name = request.scope.get("state", {}).get("certificate", "")
        return self._access.role(name, request.cookies.get(self.cookie, ""))


def _first_of(errors: ExceptionGroup[Exception]) -> BenchError:
    """Return the first error of a group, all of one input; raise the group unless it is a user's."""
    first = errors.exceptions[0]
    if isinstance(first, ExceptionGroup):
        return _first_of(first)
    if not isinstance(first, BenchError):
        raise errors
    return first


def _answered(answer: CommandAnswer) -> dict[str, Any]:
    return {"state": answer.state, "note": answer.note}


def _known(commands: Mapping[str, T], asked: Asked) -> T:
    if (command := commands.get(asked.path["name"])) is None:
        raise UnknownName("command")
    return command


def _started_pool(kind: Pool) -> ThreadPoolExecutor:
    """Return a pool whose threads run already: a stop does not wait for one to start."""
    name, threads = kind.value
    pool, together = ThreadPoolExecutor(threads, f"page-{name}"), Barrier(threads)
    wait([pool.submit(together.wait) for _ in range(threads)])
    return pool


TIMEOUT = 2.0
"""Time for which a command is retried while the bench refuses it for a passing reason, s.

Shorter than at the command line, which waits in front of the operator: nothing may move long after a click.
"""
MAX_AGE = 3.0
"""Max age of the displayed state when a command is clicked (s)."""
MAX_NUMBERS = 1024
"""Number of commands that are remembered to refuse their repetition."""


_Command = Callable[[BenchClient], CommandAnswer]

COMMANDS: Mapping[str, _Command] = {
    "reset": lambda bench: bench.reset(TIMEOUT),
    "home": lambda bench: bench.home(TIMEOUT),
    "arm": lambda bench: bench.arm(TIMEOUT),
    "disarm": BenchClient.disarm,
    "swing": lambda bench: bench.swing(TIMEOUT),
    "tee": BenchClient.tee,
    "access": BenchClient.access,
    "secure": BenchClient.secure,
}
"""Commands by name, without the stops."""
WITHOUT_LEASE = frozenset({"disarm"})
"""Commands that need no lease."""
STOPS: Mapping[str, _Command] = {"stop": BenchClient.stop, "estop": BenchClient.emergency_stop}


class CommandNumbers:
    """Numbers of received commands, so that one that arrives twice or late is refused.

    A browser or a proxy may send a request again after a lost connection, and a slow network may deliver it
    late: neither may move the robot.
    """

    def __init__(self) -> None:
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
        age = time.monotonic() - seen
        if not 0.0 <= age <= MAX_AGE:
            state = f"a state that is {age:.0f} s old" if age > 0 else "an unknown state"
            action = "Wait until the page shows the present state, then click again."
            raise Refused("command", f"given from {state}", f"a state of the last {MAX_AGE:g} s", action)


LEASE = 15.0
"""Duration of a lease from each renewal, s."""
MAX_TICKETS = 16
"""Max number of tickets; the bench gives out one lease at a time, older tickets are of lost leases."""


class _Held(NamedTuple):
    client: BenchClient
    until: float


class PageLeases:
    """The leases by ticket."""

    def __init__(self, connect: Callable[[], BenchClient]) -> None:
        """`connect` returns a new client without a lease."""
        self._connect = connect
        self._held: dict[str, _Held] = {}
        self._lock = Lock()

    def take(self, holder: str) -> dict[str, Any]:
        """Take the bench's lease for `holder`; return its ticket. Raises as `BenchClient.take_lease`."""
        client = self._connect()
        client.take_lease(holder, LEASE)
        ticket = secrets.token_urlsafe(24)
        with self._lock:
            now = time.monotonic()
            self._held = {t: held for t, held in self._held.items() if held.until > now}
            while len(self._held) >= MAX_TICKETS:
                del self._held[next(iter(self._held))]
            self._held[ticket] = _Held(client, now + LEASE)
        return {"ticket": ticket, "holder": holder, "seconds": LEASE}

    def renew(self, ticket: str) -> dict[str, Any]:
        """Renew the lease for LEASE from now; return its seconds. Raises as `BenchClient.renew_lease`."""
        client = self.client(ticket)
        try:
            seconds = client.renew_lease()
        except Refused:
            self._forget(ticket)
            raise
        with self._lock:
            if ticket in self._held:
                self._held[ticket] = _Held(client, time.monotonic() + seconds)
        return {"seconds": seconds}

    def release(self, ticket: str) -> dict[str, Any]:
        """Release the lease; an armed bench disarms. Return its seconds: 0."""
        client = self.client(ticket)
        self._forget(ticket)
        client.release_lease()
        return {"seconds": 0.0}

    def client(self, ticket: str) -> BenchClient:
        """Return the client that holds the lease of `ticket`; raises Refused: no lease, or it has expired."""
        with self._lock:
            held = self._held.get(ticket)
        if held is None or time.monotonic() > held.until:
            raise Refused("lease", "not held by this page", "the lease of the bench", "Take the lease first.")
        return held.client

    def _forget(self, ticket: str) -> None:
        with self._lock:
            self._held.pop(ticket, None)
