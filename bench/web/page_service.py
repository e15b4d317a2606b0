"""Requests of the page: lookups and commands, each with the role that it needs."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Collection
from concurrent.futures import ThreadPoolExecutor, wait
from enum import Enum
from pathlib import Path
from threading import Barrier
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from bench.base.errors import BenchError
from bench.network.bench_service import CommandAnswer
from bench.network.lease import MAX_HOLDER_LENGTH
from bench.web.answers import Asked, InvalidBody, UnknownName, body_of, json_answer, refusal_answer, text_in
from bench.web.bench_link import BenchLink
from bench.web.broadcaster import EventStream, PageBroadcaster
from bench.web.downloads import Download, static_files
from bench.web.page_access import SESSION, PageAccess, PageRole
from bench.web.page_commands import COMMANDS, STOPS, CommandNumbers, PageLeases

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

T = TypeVar("T")
MAX_DOWNLOADS = 8
"""Max number of downloads at a time."""
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
        return Response(found.content, media_type=found.kind, headers={"cache-control": "no-cache"})

    async def stream(self, request: Request) -> Any:
        """Return the messages of the bench as server-sent events."""
        return self.needing(PageRole.VIEWER, request) or EventStream(self._broadcaster, self._you(request))

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
        return _answered(STOPS[_known(STOPS, asked.path["name"])](self._link.client()))

    def command(self, asked: Asked) -> dict[str, Any]:
        """Send a command with the lease of the tab that asks."""
        command = COMMANDS[_known(COMMANDS, asked.path["name"])]
        asked.once(fresh=True)
        client = self._leases.client(asked.ticket) if command.leased else self._link.client()
        return _answered(command.send(client))

    def lease(self, asked: Asked) -> dict[str, Any]:
        """Take, renew or release the lease."""
        match asked.body.get("action"):
            case "take":
                return self._leases.take(asked.text("holder", MAX_HOLDER_LENGTH))._asdict()
            case "renew":
                return {"seconds": self._leases.renew(asked.ticket)}
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
        """Return the outcome of `work`, done in the threads for lookups."""
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


def _known(commands: Collection[str], name: str) -> str:
    if name not in commands:
        raise UnknownName("command")
    return name


def _started_pool(kind: Pool) -> ThreadPoolExecutor:
    """Return a pool whose threads run already: a stop does not wait for one to start."""
    name, threads = kind.value
    pool, together = ThreadPoolExecutor(threads, f"page-{name}"), Barrier(threads)
    wait([pool.submit(together.wait) for _ in range(threads)])
    return pool
