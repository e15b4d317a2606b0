"""Requests of the page about commissionings: `golfbench commission --sim`, beside the page.

It measures a simulated robot in a process of its own. The running bench is not touched, and needs no lease.
"""

from __future__ import annotations

import json
import os
import signal
from contextlib import suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from bench.errors import Refused
from bench.page.answers import body_of, json_answer, text_in
from bench.page.command_line import CommandLine
from bench.page.commissioning_shelf import CommissioningShelf
from bench.page.downloads import REPORT_POLICY
from bench.page.lasting_command import LastingCommand
from bench.page.page_access import PageRole
from bench.page.page_service import PageService

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

LONGEST_NAME = 121


class CommissioningService:
    """Checks, starts and ends of commissionings, and their files."""

    def __init__(
        self, page: PageService, golfbench: CommandLine, shelf: CommissioningShelf, command: LastingCommand
    ) -> None:
        self._page, self._golfbench, self._shelf, self._command = page, golfbench, shelf, command

    async def check(self, request: Request) -> Response:
        """Return the steps that a commissioning would do, or why it cannot be done."""
        if (refusal := self._page.needing(PageRole.OPERATOR, request)) is not None:
            return refusal
        robot, resumed = _wanted(await body_of(request))

        def work() -> Any:
            _, given = self._arguments(robot, resumed)
            return json.loads(self._golfbench.output(*given, "--check", "--json"))

        return await self._page.ran(work)

    async def start(self, request: Request) -> Response:
        """Begin a commissioning, or resume one."""
        if (refusal := self._page.needing(PageRole.OPERATOR, request)) is not None:
            return refusal
        body = await body_of(request)
        number, (robot, resumed) = text_in(body, "number", 64, 8), _wanted(body)

        def work() -> dict[str, Any]:
            self._page.numbers.check(number, None)
            name, given = self._arguments(robot, resumed)
            self._command.start(name, *given)
            return {"note": f"{name}: the commissioning begins, on a simulated robot."}

        return await self._page.worked(work)

    async def stop(self, request: Request) -> Response:
        """End the process of a commissioning; the step under way is done again when it is resumed."""
        if (refusal := self._page.needing(PageRole.OPERATOR, request)) is not None:
            return refusal
        body = await body_of(request)
        number, wanted = text_in(body, "number", 64, 8), text_in(body, "name", LONGEST_NAME)

        def work() -> dict[str, Any]:
            self._page.numbers.check(number, None)
            listed = self._shelf.view()["commissionings"]
            process = next((one["process"] for one in listed if one["name"] == wanted), None)
            if process is None:
                raise Refused(
                    "commissioning", "no process", "a running commissioning", "Nothing is to be done."
                )
            with suppress(ProcessLookupError):  # it has just ended
                os.kill(process, signal.SIGTERM)
            return {"note": f"{wanted} ends. It can be resumed."}

        return await self._page.worked(work)

    async def file(self, request: Request) -> Response:
        """Return the report of a commissioning as a page that can run nothing, or its robot as a file."""
        from starlette.responses import FileResponse

        if (refusal := self._page.needing(PageRole.VIEWER, request)) is not None:
            return refusal
        name, kind = request.path_params["commissioning"], request.path_params["kind"]
        path = await self._page.looked_up(lambda: self._shelf.file(name, kind))
        if path is None:
            return json_answer({"what": "There is no such file."}, 404)
        if kind == "report":
            headers = {"content-security-policy": REPORT_POLICY}
            return FileResponse(path, media_type="text/html; charset=utf-8", headers=headers)
        return FileResponse(path, media_type="application/toml", filename=f"{name}.toml")

    def _arguments(self, robot: str, resumed: str) -> tuple[str, list[str]]:
        """Return name and arguments of a commissioning of `robot`; `resumed`: go on with that one."""
        folder = self._shelf.folder(resumed) if resumed else self._shelf.new(datetime.now(UTC))
        given = ["commission", "--sim", f"--output={folder}"]
        if robot:
            given.append(f"--robot={self._shelf.robot(robot)}")
        return folder.name, [*given, "--resume"] if resumed else given


def _wanted(body: dict[str, Any]) -> tuple[str, str]:
    """Return the names of robot and resumed commissioning; empty: the configured one, a new one."""
    return text_in(body, "robot", LONGEST_NAME, 0), text_in(body, "resume", LONGEST_NAME, 0)
