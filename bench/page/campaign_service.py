"""Requests of the page about campaigns and files."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.page.answers import InvalidBody, body_of, json_answer, number_in, text_in
from bench.page.campaign_archive import REQUESTS, CampaignArchive
from bench.page.command_line import CommandLine
from bench.page.downloads import REPORT_POLICY, Downloads
from bench.page.lasting_command import LastingCommand
from bench.page.page_access import PageRole
from bench.page.page_service import PageService

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

MOVING = frozenset({"answer", "resume"})
"""Requests after which the robot moves: from a fresh screen only."""
MAX_DOWNLOADS = 8
"""Max number of downloads at a time."""
PART = 1 << 16
"""Size of a part of a file, bytes."""
LONGEST_COMMENT = 200
LONGEST_NAME = 64
STARTED = "{}: its runner starts, checks plan and bench, then takes the bench"


class CampaignService:
    """Campaigns, reports and records of one bench."""

    def __init__(
        self,
        page: PageService,
        archive: CampaignArchive,
        downloads: Downloads,
        golfbench: CommandLine,
        runner: LastingCommand,
    ) -> None:
        self._page, self._archive, self._downloads = page, archive, downloads
        self._golfbench, self._runner = golfbench, runner
        self._open = 0
        """Number of downloads under way."""

    async def archive(self, request: Request) -> Response:
        """Return the campaigns and records that are here."""

        def work() -> dict[str, Any]:
            return {"campaigns": self._archive.listed(), "records": self._downloads.records()}

        return self._page.needing(PageRole.VIEWER, request) or await self._page.worked(work)

    async def detail(self, request: Request) -> Response:
        """Return charts and landing points of one campaign."""
        name = request.path_params["campaign"]
        refusal = self._page.needing(PageRole.VIEWER, request)
        return refusal or await self._page.worked(lambda: self._archive.detail(self._archive.known(name)))

    async def record(self, request: Request) -> Any:
        """Return a record as a file."""
        if (refusal := self._page.needing(PageRole.VIEWER, request)) is not None:
            return refusal
        path = self._downloads.record(request.path_params["name"])
        if path is None:
            return json_answer({"what": "There is no such record."}, 404)
        headers = {"content-disposition": f'attachment; filename="{path.name}"'}
        return self._file(path, "application/vnd.apache.parquet", headers)

    async def report(self, request: Request) -> Any:
        """Return a report as a page that can run nothing."""
        if (refusal := self._page.needing(PageRole.VIEWER, request)) is not None:
            return refusal
        path = self._downloads.report(request.path_params["campaign"])
        if path is None:
            return json_answer({"what": "There is no such report."}, 404)
        return self._file(path, "text/html; charset=utf-8", {"content-security-policy": REPORT_POLICY})

    def _file(self, path: Path, kind: str, headers: dict[str, str]) -> Response:
        """Return the file at `path` in parts, so that a slow reader costs no more than one of them."""
        from starlette.responses import StreamingResponse

        if self._open >= MAX_DOWNLOADS:
            return json_answer({"what": "Too many downloads.", "cure": "Try again when one has ended."}, 503)
        return StreamingResponse(self._parts(path), media_type=kind, headers=headers)

    async def _parts(self, path: Path) -> AsyncIterator[bytes]:
        self._open += 1
        try:
            with path.open("rb") as stream:
                while part := await self._page.looked_up(lambda: stream.read(PART)):
                    yield part
        finally:
            self._open -= 1

    async def write_report(self, request: Request) -> Response:
        """Write the report of a campaign that has ended, as `golfbench campaign report` does."""
        if (refusal := self._page.needing(PageRole.OPERATOR, request)) is not None:
            return refusal
        campaign, body = request.path_params["campaign"], await body_of(request)
        number, units = text_in(body, "number", 64, 8), body.get("units")
        if units not in ("si", "us"):
            raise InvalidBody("units: si or us")

        def work() -> dict[str, Any]:
            self._page.numbers.check(number, None)
            known = self._archive.ended(campaign)
            self._golfbench.output("campaign", "report", f"--units={units}", "--", known)
            return {"note": f"Report of {known} written."}

        return await self._page.ran(work)

    async def change(self, request: Request) -> Response:
        """Pause, stop, abort or resume a campaign, answer its prompt, or mark a shot."""
        if (refusal := self._page.needing(PageRole.OPERATOR, request)) is not None:
            return refusal
        campaign, name = request.path_params["campaign"], request.path_params["name"]
        body = await body_of(request)
        number, seen = text_in(body, "number", 64, 8), number_in(body, "seen")
        by = text_in(body, "by", LONGEST_NAME)
        if name in REQUESTS:
            note = ""
        elif name in ("answer", "mark"):
            note = text_in(body, "comment", LONGEST_COMMENT, 0) if name == "mark" else ""
        else:
            return json_answer({"what": "There is no such request."}, 404)
        place = int(number_in(body, "prompt" if name == "answer" else "shot")) if name not in REQUESTS else 0
        balls = _count(body) if name == "answer" else None
        ask = name == "resume" and body.get("ask") is True

        def work() -> dict[str, Any]:
            self._page.numbers.check(number, seen if name in MOVING else None)
            if name == "answer":
                return {"note": f"Done: {self._archive.answer(campaign, place, by, balls)}"}
            if name == "mark":
                self._archive.mark(campaign, place, by, note)
                return {"note": f"Shot {place} marked."}
            if name == "resume" and not self._archive.has_runner(campaign):
                return {"note": f"{self._resume(campaign, by, ask=ask)}."}
            return {"note": f"{campaign} {self._archive.request(campaign, name, by)}."}

        return await self._page.worked(work)

    def _resume(self, campaign: str, by: str, *, ask: bool) -> str:
        """Start a runner for a campaign that has none; return what happens."""
        known = self._archive.unfinished(campaign)
        more = ["--ask"] if ask else []
        self._runner.start(known, "campaign", "resume", f"--by={by}", *more, "--", known)
        return STARTED.format(known)


def _count(body: dict[str, Any]) -> int | None:
    """Return the number of loaded balls in `body`; None without one."""
    if body.get("balls") is None:
        return None
    balls = number_in(body, "balls")
    if balls != int(balls) or not 0 <= balls < 10_000:
        raise InvalidBody("balls: a count")
    return int(balls)
