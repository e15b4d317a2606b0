"""Requests of the page about campaigns and files: from the database of the configured bench.

Requests go through the database to the runner, as `golfbench campaign pause` and the others send them. The
control chart of a running campaign is of its control ball; landing points of the compared balls appear when
it has ended, since each look before costs confidence.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.base.errors import BenchError, ExitCode, Refused
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.plan_file import plan_from_record
from bench.campaign.plan.shot_sequence import Role, sections
from bench.campaign.report.campaign_record import with_exclusions
from bench.campaign.run.campaign_control import answer, ask, is_running, standing_now
from bench.config import Configuration, database_url
from bench.records.shot.shot import Shot, ShotStatus
from bench.store.campaigns import CampaignStore
from bench.store.database import is_there, open_database
from bench.store.rows import ENDED, MAX_COMMENT_LENGTH, CampaignState, ShotNote, places
from bench.web._answers import MAX_RECORDS, REPORT, Asked, Download, Downloads, InvalidBody, UnknownName
from bench.web._command_line import BackgroundCommand, CommandLine
from bench.web._last_swing import swing_view

MAX_LISTED = 50
STARTED = "{}: its runner starts, checks plan and bench, then takes the bench"
REQUESTS = {"pause": "pause", "stop": "stop", "abort": "abort", "resume": ""}
"""Requests to a campaign's runner, by their name on the page."""


class CampaignService:
    """Campaigns, reports and records of one bench on this machine."""

    def __init__(
        self,
        configuration: Configuration,
        downloads: Downloads,
        golfbench: CommandLine,
        runner: BackgroundCommand,
    ) -> None:
        bench = configuration.bench
        self._downloads, self._golfbench, self._runner = downloads, golfbench, runner
        self._bench, self.data_dir = bench.id, bench.data_dir
        self._url = database_url(bench.database, bench.data_dir)
        self._details: dict[str, tuple[Any, dict[str, Any] | None]] = {}
        """Key and content of the newest detail of each running campaign."""

    @contextmanager
    def store(self) -> Iterator[CampaignStore]:
        """Yield the opened database; raises Refused: this computer has no database of the bench."""
        if not is_there(self._url):
            location, expected = f"bench {self._bench}", "the database on the bench's computer"
            raise Refused(
                location, "no campaigns on this computer", expected, "Use the page of that computer."
            )
        with open_database(self._url) as engine:
            yield CampaignStore(engine)

    def listed(self, search: str = "") -> list[dict[str, Any]]:
        """Return the newest campaigns whose id or title has `search`; empty without a database."""
        if not is_there(self._url):
            return []
        with self.store() as store:
            rows = [row for row in store.entries() if search in f"{row[0].id} {row[0].title}".casefold()]
        found = [
            (entry, standing_now(self.data_dir, entry.id, standing), counts)
            for entry, standing, counts in rows[:MAX_LISTED]
        ]
        folder = self.data_dir / "campaigns"
        return [
            {
                "id": entry.id,
                "title": entry.title,
                "date": entry.date.isoformat(timespec="seconds"),
                "state": str(standing.state),
                "reason": standing.reason,
                "shots": sum(counts.values()),
                "valid": counts[ShotStatus.VALID],
                "report": (folder / entry.id / "report.html").is_file(),
                "ended": standing.state in ENDED,
                "runner": standing.state not in ENDED and is_running(self.data_dir, entry.id),
            }
            for entry, standing, counts in found
        ]

    def state(self, campaign: str) -> CampaignState:
        """Return the state of `campaign`; raises BenchError: no such campaign."""
        with self.store() as store:
            standing = store.standing(store.entry(campaign).id)
        return standing_now(self.data_dir, campaign, standing).state

    def details_of(self, campaign: str) -> dict[str, Any]:
        """Return prompt, control charts and, after its end, landing points of `campaign`.

        Raises:
            BenchError: there is no such campaign here.
        """
        with self.store() as store:
            entry = store.entry(campaign)
            plan = plan_from_record(entry.plan, f"campaign {entry.id}")
            taken = [stored.shot for stored in store.shots(entry.id)]
            shots = with_exclusions(taken, store.exclusions(entry.id))
            open_prompts = [
                {"number": one.number, "text": one.text, "places": places(one.balls)}
                for one in store.prompts(entry.id)
                if one.answered is None
            ]
            state = standing_now(self.data_dir, entry.id, store.standing(entry.id)).state
        return {
            "campaign": entry.id,
            "title": entry.title,
            "state": str(state),
            "prompt": open_prompts[-1] if open_prompts else None,
            "charts": _charts(plan, shots),
            "interim": None if state in ENDED else _interim(plan, shots),
            "landing": _landing(plan, shots) if state in ENDED else None,
            "runner": is_running(self.data_dir, entry.id),
        }

    def running(self, messages: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Return progress and detail of running campaigns; details are read again when a message changed."""
        found = [(str(one.get("campaign")), one) for one in messages]
        self._details = {name: self._running_detail(name, one) for name, one in found}
        return [{"progress": one, "detail": self._details[name][1]} for name, one in found]

    def _running_detail(self, name: str, message: dict[str, Any]) -> tuple[Any, dict[str, Any] | None]:
        """Return the key of the detail of campaign `name`, and the detail; None if it is not here."""
        key = [message.get(part) for part in ("shots", "state", "reason")]
        if (known := self._details.get(name)) is not None and known[0] == key:
            return known
        try:
            return key, self.details_of(name)
        except (BenchError, ExceptionGroup, OSError):
            return key, None

    def archive(self, asked: Asked) -> dict[str, Any]:
        """Return the campaigns and records that are here, or those that the searched text names."""
        search = asked.path.get("search", "").strip().casefold()
        return {"campaigns": self.listed(search), "records": self._downloads.records(search)}

    def swing(self, asked: Asked) -> dict[str, Any]:
        """Return figures and curves of a record."""
        path = self._record(asked.path["name"])
        try:
            return swing_view(path)
        except (ValueError, KeyError, OSError) as error:
            expected, action = "a record of this version", "Download it, and look at it with golfbench view."
            raise Refused(path.name, str(error), expected, action) from error

    def wear(self, asked: Asked) -> Any:
        """Return what wears, as `golfbench wear --json` does, by the records named."""
        names = asked.body.get("records")
        if not isinstance(names, list) or not 0 < len(names) <= MAX_RECORDS:
            raise InvalidBody(f"records: 1 to {MAX_RECORDS} names")
        files = [str(self._record(str(name))) for name in names]
        asked.once()
        # A worn part ends the command with the code of a refusal.
        return json.loads(
            self._golfbench.output("wear", "--json", "--", *files, passed=(0, ExitCode.REFUSED))
        )

    def _record(self, name: str) -> Path:
        if (found := self._downloads.record(name)) is None:
            raise UnknownName("record")
        return found

    def detail(self, asked: Asked) -> dict[str, Any]:
        """Return charts and landing points of one campaign."""
        return self.details_of(asked.path["campaign"])

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
        if (state := self.state(campaign)) not in ENDED:
            action = f"golfbench campaign report {campaign}: each look before the end costs confidence."
            raise Refused(f"campaign {campaign}", str(state), "an ended campaign", action)
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
                with self.store() as store:
                    now, data_dir = datetime.now(UTC), self.data_dir
                    text, _ = answer(store, data_dir, campaign, by, now, balls, number=prompt)
                return {"note": f"Done: {text}"}
            case "mark":
                shot, comment = int(asked.number("shot")), asked.text("comment", MAX_COMMENT_LENGTH, 0)
                asked.once()
                with self.store() as store:
                    store.add_note(store.entry(campaign).id, ShotNote(shot, datetime.now(UTC), by, comment))
                return {"note": f"Shot {shot} marked."}
            case _ if name not in REQUESTS:
                raise UnknownName("request")
        asked.once(fresh=name == "resume")  # the robot moves then
        data_dir = self.data_dir
        state = self.state(campaign)  # raises for an unknown campaign, before other files
        if name == "resume" and not is_running(data_dir, campaign):
            if state in ENDED:
                expected, action = "an unfinished campaign", "Begin a new one."
                raise Refused(f"campaign {campaign}", str(state), expected, action)
            more = ["--ask"] if asked.body.get("ask") is True else []
            self._runner.start(campaign, "campaign", "resume", "--json", f"--by={by}", *more, "--", campaign)
            return {"note": f"{STARTED.format(campaign)}."}
        with self.store() as store:
            return {"note": f"{campaign} {ask(store, data_dir, campaign, REQUESTS[name], by)}."}


def _charts(plan: CampaignPlan, shots: list[Shot]) -> list[dict[str, Any]]:
    from bench.campaign.statistics.control_chart import control_charts

    if not shots:
        return []
    mine = [shot for shot in shots if shot.section == shots[-1].section]
    fields = ("column", "shots", "values", "centre", "sd")
    return [
        {name: getattr(chart, name) for name in fields}
        | {"signals": sorted({shot for shots in chart.signals.values() for shot in shots})}
        for chart in control_charts(plan, mine)
    ]


def _interim(plan: CampaignPlan, shots: list[Shot]) -> dict[str, Any] | None:
    """Return the section of the last shot as the plan's stopping rule saw it at its latest look."""
    from bench.campaign.statistics.analysis import interim_analysis

    section = shots[-1].section if shots else 0
    found = interim_analysis(plan, [shot for shot in shots if shot.section == section])
    if found is None:
        return None
    fields = ("first", "second", "difference", "low", "high", "verdict")
    return {
        "block": found[0],
        "blocks": plan.design.blocks,
        "column": plan.analysis.quantity,
        "pairs": [{name: getattr(pair, name) for name in fields} for pair in found[1].pairs],
    }


def _landing(plan: CampaignPlan, shots: list[Shot]) -> list[dict[str, Any]]:
    from bench.campaign.statistics.control_chart import dispersion_ellipses

    fields = {"level": "name", "centre": "centre", "long": "long_axis", "short": "short_axis", "tilt": "tilt"}
    found = []
    for section in sections(plan):
        mine = [shot for shot in shots if shot.section == section.number]
        points = [
            {"level": str(getattr(one, plan.design.compare)), "side": one.carry_side_m, "carry": one.carry_m}
            for one in mine
            if one.role == Role.TEST and one.status is ShotStatus.VALID
            if one.carry_m is not None and one.carry_side_m is not None
        ]
        ellipses = [
            {key: getattr(one, field) for key, field in fields.items()}
            for one in dispersion_ellipses(plan, mine)
        ]
        found.append({"section": section.name, "points": points, "ellipses": ellipses})
    return found


def _count(asked: Asked) -> int | None:
    """Return the number of loaded balls; None without one."""
    if asked.body.get("balls") is None:
        return None
    balls = asked.number("balls")
    if balls != int(balls) or not 0 <= balls < 10_000:
        raise InvalidBody("balls: a count")
    return int(balls)
