"""Requests of the page about campaigns and files."""

from __future__ import annotations

from typing import Any

from bench.errors import Refused
from bench.page.answers import Asked, InvalidBody, UnknownName
from bench.page.background_command import BackgroundCommand
from bench.page.campaign_archive import REQUESTS, CampaignArchive
from bench.page.command_line import CommandLine
from bench.page.downloads import REPORT, Download, Downloads
from bench.store.records import ENDED

LONGEST_COMMENT = 200
STARTED = "{}: its runner starts, checks plan and bench, then takes the bench"


class CampaignService:
    """Campaigns, reports and records of one bench."""

    def __init__(
        self,
        archive: CampaignArchive,
        downloads: Downloads,
        golfbench: CommandLine,
        runner: BackgroundCommand,
    ) -> None:
        self._archive, self._downloads = archive, downloads
        self._golfbench, self._runner = golfbench, runner

    def archive(self, _: Asked) -> dict[str, Any]:
        """Return the campaigns and records that are here."""
        return {"campaigns": self._archive.listed(), "records": self._downloads.records()}

    def detail(self, asked: Asked) -> dict[str, Any]:
        """Return charts and landing points of one campaign."""
        return self._archive.detail(asked.path["campaign"])

    def record(self, path: dict[str, str]) -> Download | None:
        """Return a record as a file."""
        found = self._downloads.record(path["name"])
        return None if found is None else Download.named(found, "application/vnd.apache.parquet", found.name)

    def report(self, path: dict[str, str]) -> Download | None:
        """Return a report as a page that can run nothing."""
        found = self._downloads.report(path["campaign"])
        return None if found is None else Download(found, *REPORT)

    def write_report(self, asked: Asked) -> dict[str, Any]:
        """Write the report of a campaign that has ended, as `golfbench campaign report` does."""
        units, campaign = asked.units(), asked.path["campaign"]
        asked.once()
        if (state := self._archive.state(campaign)) not in ENDED:
            cure = f"golfbench campaign report {campaign}: each look before the end costs confidence."
            raise Refused(f"campaign {campaign}", str(state), "an ended campaign", cure)
        self._golfbench.output("campaign", "report", f"--units={units}", "--", campaign)
        return {"note": f"Report of {campaign} written."}

    def change(self, asked: Asked) -> dict[str, Any]:
        """Pause, stop, abort or resume a campaign, answer its prompt, or mark a shot."""
        campaign, name = asked.path["campaign"], asked.path["name"]
        by = asked.text("by")
        match name:
            case "answer":
                prompt, balls = int(asked.number("prompt")), _count(asked)
                asked.once(fresh=True)  # the robot moves then
                return {"note": f"Done: {self._archive.answer(campaign, prompt, by, balls)}"}
            case "mark":
                shot, comment = int(asked.number("shot")), asked.text("comment", LONGEST_COMMENT, 0)
                asked.once()
                self._archive.mark(campaign, shot, by, comment)
                return {"note": f"Shot {shot} marked."}
            case _ if name not in REQUESTS:
                raise UnknownName("request")
        asked.once(fresh=name == "resume")  # the robot moves then
        if name == "resume" and not self._archive.has_runner(campaign):
            return {"note": f"{self._resume(campaign, by, ask=asked.body.get('ask') is True)}."}
        return {"note": f"{campaign} {self._archive.request(campaign, name, by)}."}

    def _resume(self, campaign: str, by: str, *, ask: bool) -> str:
        """Start a runner for a campaign that has none; return what happens."""
        if (state := self._archive.state(campaign)) in ENDED:
            raise Refused(f"campaign {campaign}", str(state), "an unfinished campaign", "Begin a new one.")
        more = ["--ask"] if ask else []
        self._runner.start(campaign, "campaign", "resume", "--json", f"--by={by}", *more, "--", campaign)
        return STARTED.format(campaign)


def _count(asked: Asked) -> int | None:
    """Return the number of loaded balls; None without one."""
    if asked.body.get("balls") is None:
        return None
    balls = asked.number("balls")
    if balls != int(balls) or not 0 <= balls < 10_000:
        raise InvalidBody("balls: a count")
    return int(balls)
