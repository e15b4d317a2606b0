"""Requests of the page: what is looked up, and the commands, each with the role that it needs."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor, wait
from threading import Barrier
from typing import TYPE_CHECKING, Any, TypeVar

from bench.errors import BenchError
from bench.network.client import BenchClient
from bench.network.command import CommandAnswer
from bench.network.lease import LONGEST_HOLDER
from bench.page.answers import InvalidBody, body_of, json_answer, number_in, refusal_answer, text_in
from bench.page.bench_link import BenchLink
from bench.page.broadcaster import PageBroadcaster
from bench.page.event_stream import EventStream
from bench.page.page_access import SESSION, PageAccess, PageRole
from bench.page.page_commands import COMMANDS, STOPS, CommandNumbers
from bench.page.page_leases import PageLeases
from bench.page.static_files import static_files

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

T = TypeVar("T")
TICKET = "golfbench-ticket"
"""Header with the ticket of a lease."""
_GUESS_TIME = 1.0
"""Time that a wrong token costs, one after the other, s."""


class PageService:
    """The page of one bench."""

    def __init__(
        self, link: BenchLink, broadcaster: PageBroadcaster, access: PageAccess, *, secure: bool
    ) -> None:
        """`secure`: reached by TLS."""
        self._link, self._broadcaster, self._access, self._secure = link, broadcaster, access, secure
        self._leases, self.numbers = PageLeases(link.client), CommandNumbers()
        self._files = static_files()
        self._work = _started_pool(8, "page-command")
        self._lookups = _started_pool(2, "page-lookup")
        self._programs = _started_pool(4, "page-program")
        """Wait for programs that run beside the page."""
        self._stops = _started_pool(4, "page-stop")
        """Of their own: a stop waits behind nothing."""
        self._signing_in = asyncio.Lock()

    def close(self) -> None:
        """End the threads of commands."""
        for pool in (self._work, self._lookups, self._programs, self._stops):
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
                return json_answer({"what": "This token is unknown.", "cure": "Type it again."}, 401)
        response = json_answer({})
        response.set_cookie(
            self.cookie, session, int(SESSION), httponly=True, samesite="strict", secure=self._secure
        )
        return response

    # Commands ------------------------------------------------------------------------------------

    async def stop(self, request: Request) -> Response:
        """Stop the robot, whatever the body says; no lease, no number, no age."""
        if (refusal := self.needing(PageRole.STOPPER, request)) is not None:
            return refusal
        if (send := STOPS.get(request.path_params["name"])) is None:
            return json_answer({"what": "There is no such stop."}, 404)
        return await self._send(self._stops, lambda: send(self._link.client()))

    async def command(self, request: Request) -> Response:
        """Send a command with the lease of the tab that asks."""
        command = COMMANDS.get(request.path_params["name"])
        if command is None:
            return json_answer({"what": "There is no such command."}, 404)
        if (refusal := self.needing(PageRole.OPERATOR, request)) is not None:
            return refusal
        body, ticket = await body_of(request), request.headers.get(TICKET, "")
        number, seen = text_in(body, "number", 64, 8), number_in(body, "seen")

        def send() -> CommandAnswer:
            self.numbers.check(number, seen)
            client: BenchClient = self._leases.client(ticket) if command.leased else self._link.client()
            return command.send(client)

        return await self._send(self._work, send)

    async def lease(self, request: Request) -> Response:
        """Take, renew or release the lease."""
        if (refusal := self.needing(PageRole.OPERATOR, request)) is not None:
            return refusal
        body, ticket = await body_of(request), request.headers.get(TICKET, "")
        match body.get("action"):
            case "take":
                holder = text_in(body, "holder", LONGEST_HOLDER)
                return await self.answered(self._work, lambda: self._leases.take(holder)._asdict())
            case "renew":
                return await self.answered(self._work, lambda: {"seconds": self._leases.renew(ticket)})
            case "release":
                return await self.answered(self._work, lambda: self._leases.release(ticket))
        raise InvalidBody("action: take, renew or release")

    async def _send(self, pool: Executor, send: Callable[[], CommandAnswer]) -> Response:
        def work() -> dict[str, Any]:
            answer = send()
            return {"state": answer.state, "note": answer.note}

        return await self.answered(pool, work)

    # Helpers -------------------------------------------------------------------------------------

    async def worked(self, work: Callable[[], Any]) -> Response:
        """Return the outcome of `work`, done beside the commands, or why it was refused."""
        return await self.answered(self._lookups, work)

    async def ran(self, work: Callable[[], Any]) -> Response:
        """Return the outcome of `work`, which waits for a program, or why it was refused."""
        return await self.answered(self._programs, work)

    async def looked_up(self, work: Callable[[], T]) -> T:
        """Return the outcome of `work`, done beside the commands."""
        return await asyncio.get_running_loop().run_in_executor(self._lookups, work)

    async def answered(self, pool: Executor, work: Callable[[], Any]) -> Response:
        """Return the outcome of `work`, done in `pool`, or why it was refused."""
        try:
            return json_answer(await asyncio.get_running_loop().run_in_executor(pool, work))
        except BenchError as error:
            return refusal_answer(error)
        except ExceptionGroup as errors:
            return refusal_answer(_first_of(errors))

    def needing(self, role: PageRole, request: Request) -> Response | None:
        """Return the refusal of a reader with a lower role than `role`; None for others."""
        found = self._role(request)
        if found is None:
            return json_answer({"what": "Not signed in.", "cure": "Sign in with a token."}, 401)
        if found < role:
            what = f"Your role does not allow it: {found.name.lower()}, needs {role.name.lower()}."
            return json_answer({"what": what, "cure": "Ask the owner of the bench for a role."}, 403)
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


def _started_pool(threads: int, name: str) -> ThreadPoolExecutor:
    """Return a pool whose threads run already: a stop does not wait for one to start."""
    pool, together = ThreadPoolExecutor(threads, name), Barrier(threads)
    wait([pool.submit(together.wait) for _ in range(threads)])
    return pool
