"""Requests of the page that run a command of `golfbench`: plans, values, viewer, commissionings.

A campaign starts from a shipped plan, or from one of the bench: a file in the folder `plans` next to its
records. A request names one of the listed ones and nothing else.

A form of the browser is a command with its options, which checks ranges and plausibility; its message is
shown. Nothing is overwritten: a newer entry supersedes, and a running bench takes calibrations up when it is
started again.

`golfbench commission --sim` measures a simulated robot in a separate process. The running bench is not
affected, and needs no lease. Each commissioning has a folder in `commissioning` next to the bench's records;
robots other than the configured one are configurations in the folder `robots` there.
"""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Collection, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from ipaddress import ip_address
from itertools import groupby, islice, takewhile
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from bench.base.errors import BenchError, Refused
from bench.base.from_toml import parse_toml, read_text
from bench.calibration.archive import calibration_of
from bench.calibration.calibration import CalibrationKind, in_words
from bench.campaign.plan.plan_file import EXAMPLES, campaign_names
from bench.config import Configuration, database_url
from bench.store.campaigns import CampaignStore
from bench.store.database import is_there, open_database
from bench.swing.library import profile_names
from bench.web._answers import (
    PLAIN_NAME,
    REPORT,
    Asked,
    Download,
    InvalidBody,
    UnknownName,
    json_answer,
    number_in,
    plain_file,
    text_in,
)
from bench.web._campaign_service import STARTED
from bench.web._command_line import BackgroundCommand, CommandLine, ViewerProcess
from bench.web._page_service import PageService, Pool
from bench.web.page_access import PageRole

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

    from bench.base.address import BenchSettings
    from bench.commissioning.commissioning import DoneStep

MAX_FILES = 100
"""Max number of listed plans, and of listed robots."""
MAX_FILE_BYTES = 1 << 20
"""Max size of such a file, bytes."""

_MAX_ABOUT_LENGTH = 400
_MAX_NAME_LENGTH = 80
_MAX_LACKS = 20
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,80}")


class PlanCatalogue:
    """The plans of one bench."""

    def __init__(self, data_dir: Path, known: Mapping[str, Collection[str]]) -> None:
        """`known` are the names that the configuration has in its sections `balls` and `clubs`."""
        self.folder, self.known = data_dir / "plans", known

    def listed(self) -> list[dict[str, Any]]:
        """Return each plan's name, title, leading comment and missing names, and whether it is shipped.

        Plans that need a club or a ball of another configuration come last: they would be refused.
        """
        plans = [_described(name, file, self.known) for name, file in self._files().items()]
        return sorted(plans, key=lambda plan: bool(plan["lacks"]))

    def file(self, name: str) -> Path:
        """Return the file of the plan called `name`; one of the bench hides a shipped one.

        Raises:
            Refused: no such plan is listed.
        """
        return listed_file("plan", self._files(), name, f"Put it into {self.folder}.")

    def _files(self) -> dict[str, Path]:
        shipped = {name: EXAMPLES / f"{name}.toml" for name in campaign_names()}
        return shipped | toml_files(self.folder)


def listed_file(what: str, files: Mapping[str, Path], name: str, action: str) -> Path:
    """Return the one of `files` that is called `name`; raises Refused: there is none."""
    if name not in files:
        raise Refused(what, "an unknown name", "one of the listed ones", action)
    return files[name]


def toml_files(folder: Path) -> dict[str, Path]:
    """Return the TOML files of a plan's size in `folder`, no links, whose names are safe to show, by name."""
    try:
        found = [path for path in sorted(folder.glob("*.toml"))[:MAX_FILES] if plain_file(path)]
        return {
            path.stem: path
            for path in found
            if _NAME.fullmatch(path.stem) and path.stat().st_size <= MAX_FILE_BYTES
        }
    except OSError:
        return {}


def _described(name: str, file: Path, known: Mapping[str, Collection[str]]) -> dict[str, Any]:
    """Return a plan for the list; one that cannot be read is checked in words when it is chosen."""
    title, about, lacks = name, "", []
    try:
        text = read_text(file, "a plan", "Correct the path.")
        lines = takewhile(lambda line: line.startswith("#"), text.splitlines())
        about = " ".join(line.removeprefix("#").strip() for line in lines)[:_MAX_ABOUT_LENGTH]
        plan = parse_toml(text, str(file))
        campaign = plan.get("campaign")
        if isinstance(campaign, dict) and isinstance(campaign.get("title"), str) and campaign["title"]:
            title = campaign["title"][:200]
        lacks = [one for section, names in known.items() for one in _lacking(plan, section, names)]
    except BenchError:
        pass
    return {"name": name, "title": title, "about": about, "shipped": file.parent == EXAMPLES, "lacks": lacks}


def _lacking(plan: Mapping[str, Any], section: str, known: Collection[str]) -> list[str]:
    """Return the names in `section` of the design that are neither `known` nor defined in the plan."""
    design, own = plan.get("design", {}), plan.get(section, {})
    wanted = design.get(section) if isinstance(design, dict) else None
    if not isinstance(wanted, list) or not isinstance(own, dict):
        return []
    names = [one[:_MAX_NAME_LENGTH] for one in wanted if isinstance(one, str) and one not in own]
    return [one for one in names if one not in known][:_MAX_LACKS]


def _chosen(body: Mapping[str, Any], key: str) -> list[str]:
    """Return the options `key` of `golfbench campaign new` for the names in `body`."""
    names = body.get(f"{key}s", [])
    if not isinstance(names, list) or len(names) > MAX_NAMES:
        raise InvalidBody(f"{key}s: at most {MAX_NAMES} names")
    return [f"--{key}={text_in({key: name}, key, _MAX_NAME_LENGTH)}" for name in names]


MAX_NAMES = 50
"""Max number of balls, clubs or swings in a new plan."""
MAX_BLOCKS = 200


class StartService:
    """Checks and starts of campaigns, entries of measured values, and the viewer."""

    def __init__(
        self,
        page: PageService,
        golfbench: CommandLine,
        plans: PlanCatalogue,
        runner: BackgroundCommand,
        viewer: ViewerProcess,
        configuration: Configuration,
    ) -> None:
        self._page, self._golfbench, self._plans = page, golfbench, plans
        self._runner, self._viewer, self._configuration = runner, viewer, configuration

    def plans(self, _: Asked) -> list[dict[str, Any]]:
        """Return the plans that a campaign can be started from."""
        return self._plans.listed()

    def check(self, asked: Asked) -> dict[str, Any]:
        """Return the preview of a plan, or its mistakes."""
        name = asked.path["plan"]
        file = self._plans.file(name)
        found = json.loads(self._golfbench.output("campaign", "check", "--json", "--", str(file)))
        kept = {key: value for key, value in found.items() if key not in _LEFT_OUT}
        return kept | {"plan": name, "order": _order(found["sequence"])}

    def names(self, _: Asked) -> dict[str, list[str]]:
        """Return the balls, clubs and swings that a new plan may name."""
        return {section: list(names) for section, names in self._plans.known.items()} | {
            "swings": profile_names()
        }

    def write_plan(self, asked: Asked) -> dict[str, Any]:
        """Write a plan from a form with `save`, or only return its duration and resolution as text."""
        name, compared = asked.text("name", _MAX_NAME_LENGTH), asked.text("compare", 8)
        if not _NAME.fullmatch(name):
            raise InvalidBody("name: letters, digits, dots, - and _")
        given = [f"--compare={compared}"]
        for key in ("ball", "club", "swing"):
            given += _chosen(asked.body, key)
        lengths = [f"--{key}={asked.number(key)!r}" for key in ("difference", "sd")]
        with TemporaryDirectory() as tried:
            save = asked.body.get("save") is True
            if save:
                asked.once()
                self._plans.folder.mkdir(parents=True, exist_ok=True)
            file = (self._plans.folder if save else Path(tried)) / f"{name}.toml"
            said = self._golfbench.output("campaign", "new", *given, *lengths, "--", str(file))
        return {"words": said.splitlines()[:-1], "saved": save}

    def start(self, asked: Asked) -> dict[str, Any]:
        """Start a campaign from a plan, as it was checked."""
        name, by, units, digest = asked.path["plan"], asked.text("by"), asked.units(), asked.text("digest")
        if not _DIGEST.fullmatch(digest):
            raise InvalidBody("digest: that of the checked plan")
        asked.once(fresh=True)
        # A plan that was changed since it was checked is refused by the runner.
        given = [f"--by={by}", f"--units={units}", f"--expect={digest}"]
        given += ["--ask"] if asked.body.get("ask") is True else []
        self._runner.start(name, "campaign", "run", "--json", *given, "--", str(self._plans.file(name)))
        return {"note": f"{STARTED.format(name)}."}

    def values(self, _: Asked) -> dict[str, Any]:
        """Return calibrations in force, problems, the air, and the clubs to measure."""
        return bench_values(self._configuration)

    def enter(self, asked: Asked) -> dict[str, Any]:
        """Store the values of a form."""
        arguments = form_arguments(asked.path["form"], asked.body, asked.text("by"))
        asked.once()
        return {"note": self._golfbench.output(*arguments).strip()}

    async def viewer(self, request: Request) -> Response:
        """Open Rerun's viewer, which is started unless it runs."""
        from starlette.responses import RedirectResponse

        if (refusal := self._page.needing(PageRole.OPERATOR, request)) is not None:
            return refusal
        if request.headers.get("sec-fetch-site", "") != "same-origin":  # it starts a program
            return json_answer({"what": "Open it by its link on the page."}, 403)
        if request.client is None or not ip_address(request.client.host).is_loopback:
            what = "Rerun's viewer can be reached from the page's own computer only."
            return json_answer({"what": what, "action": "There: golfbench view, or open this page."}, 403)
        found: list[str] = []
        answer = await self._page.answered(Pool.PROGRAMS, lambda: found.append(self._viewer.url()))
        return RedirectResponse(found[0], 303) if found else answer

    def close_viewer(self, _: Asked) -> None:
        """End Rerun's viewer."""
        self._viewer.close()


_DIGEST = re.compile(r"[0-9a-f]{8,64}")
_LEFT_OUT = frozenset({"sequence", "loads", "outlook"})


def _order(sequence: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the shot order by block: its section, number, and the shots as role, swing, club, ball."""
    shot = itemgetter("role", "swing", "club", "ball")
    blocks = islice(groupby(sequence, itemgetter("section", "block")), MAX_BLOCKS)
    return [{"section": at[0], "block": at[1], "shots": [*map(shot, trials)]} for at, trials in blocks]


MAX_NOTE_LENGTH = 200
_ANGLES = {"loft-deg": 1, "lie-deg": 1, "angle-uncertainty-deg": 1}
_FORMS = {
    "air": {"temperature": 1, "pressure": 1, "humidity": 1},
    "encoders": {"from-pose": 3, "uncertainty-deg": 1, "counts": 3, "sign": 3},
    "ball": {"x": 1, "y": 1, "uncertainty-mm": 1},
    "club": {"length": 1, "length-uncertainty-mm": 1, **_ANGLES},
    "valves": {"centre": 3, "dead-band": 3, "uncertainty": 1},
}
"""Options that a form may set, and how many numbers each takes; aerodynamics come from files: no form."""


def form_arguments(form: str, body: dict[str, Any], by: str) -> list[str]:
    """Return the command's arguments for the values in `body`, entered `by` a person.

    Each of its `numbers` is an option of the form with its value or values.

    Raises:
        UnknownName: there is no such form.
        InvalidBody: a value is no number or text, or the form has no such option.
    """
    if form not in _FORMS:
        raise UnknownName("form")
    lasting = form != "air"
    allowed = _FORMS[form] | ({"expires-days": 1} if lasting else {})
    if not isinstance(numbers := body.get("numbers"), dict):
        raise InvalidBody("numbers: an object")
    found = ["calibrate" if lasting else "campaign", form, f"--by={by}"]
    for option, value in numbers.items():
        given = value if isinstance(value, list) else [value]
        if allowed.get(option) != len(given):
            raise InvalidBody(f"numbers: {', '.join(f'{name} ({n})' for name, n in allowed.items())}")
        for one in given:
            number_in({option: one}, option)
        found += [f"--{option}", *map(repr, given)]
    for key in ("method", "note"):
        if key in body and (text := text_in(body, key, MAX_NOTE_LENGTH, 0)):
            found.append(f"--{key}={text}")
    return [*found, "--", text_in(body, "club", MAX_NOTE_LENGTH)] if "club" in body else found


def bench_values(configuration: Configuration) -> dict[str, Any]:
    """Return calibrations in force, problems, the newest air, and the clubs of the configuration.

    Raises:
        BenchError: the database cannot be read.
    """
    now = datetime.now(UTC)
    calibration = calibration_of(configuration, now)
    entries = []
    for kind in CalibrationKind:
        entry = calibration.of(kind)
        nominal = "not checked" if kind is CalibrationKind.INPUTS else "nominal value of the configuration"
        missing = "missing" if calibration.required else nominal
        if any(bad.kind == kind for bad in calibration.unreadable):
            missing = "unreadable"
        entries.append(
            {
                "kind": kind.value,
                "words": missing if entry is None else in_words(entry.values),
                "version": None if entry is None else entry.version,
                "by": "" if entry is None else entry.by,
                "date": None if entry is None else entry.date.isoformat(timespec="seconds"),
                "expires": None if entry is None else entry.expires.isoformat(timespec="seconds"),
                "expired": entry is not None and entry.expired(now),
            }
        )
    return {
        "club": calibration.club,
        "clubs": list(configuration.clubs),
        "entries": entries,
        "problems": [problem.text for problem in calibration.problems(now)],
        "air": _air(configuration, now),
    }


def _air(configuration: Configuration, now: datetime) -> dict[str, Any] | None:
    """Return the newest reading of the air; None without one."""
    bench = configuration.bench
    url = database_url(bench.database, bench.data_dir)
    if not is_there(url):
        return None
    with open_database(url, now) as engine:
        found = CampaignStore(engine).newest_air(bench.id, datetime(1970, 1, 1, tzinfo=UTC))
    if found is None:
        return None
    return {
        "temperature_c": found.air.temperature - 273.15,
        "pressure_hpa": found.air.pressure / 100.0,
        "humidity_percent": 100.0 * found.air.relative_humidity,
        "date": found.date.isoformat(timespec="seconds"),
        "by": found.by,
    }


# Commissionings --------------------------------------------------------------------------------------

MAX_LISTED = 10
MAX_FOLDER_LENGTH, MAX_REPAIRED = 121, 200
FILES = {"report": "report.html", "robot": "robot.toml"}
"""Files of a commissioning by their names on the page."""


class CommissioningService:
    """The commissionings of one bench: their checks, starts, ends and files."""

    def __init__(self, bench: BenchSettings, golfbench: CommandLine, command: BackgroundCommand) -> None:
        self._bench, self._golfbench, self._command = bench.id, golfbench, command
        self._folder, self._robots = bench.data_dir / "commissioning", bench.data_dir / "robots"

    def view(self) -> dict[str, Any]:
        """Return robots and commissionings, the newest first, as the page shows them."""
        return {
            "robots": list(toml_files(self._robots)),
            "folder": str(self._robots),
            "commissionings": [_commissioning(folder) for folder in self._folders()],
        }

    def folder(self, name: str) -> Path:
        """Return the folder of the commissioning called `name`.

        Raises:
            Refused: no such commissioning is listed.
        """
        listed = {path.name: path for path in self._folders()}
        return listed_file("commissioning", listed, name, "Load the page again.")

    def robot(self, name: str) -> Path:
        """Return the file of the robot called `name`; raises Refused: no such robot is listed."""
        action = f"Put its configuration into {self._robots}."
        return listed_file("robot", toml_files(self._robots), name, action)

    def _folders(self) -> list[Path]:
        try:
            listed = [
                p for p in self._folder.iterdir() if PLAIN_NAME.fullmatch(p.name) and not p.is_symlink()
            ]
            if not listed:  # the import costs a second
                return []
            from bench.commissioning.commissioning import STATE_FILE

            found = [path for path in listed if plain_file(path / STATE_FILE)]
            found.sort(key=lambda path: (path / STATE_FILE).stat().st_mtime_ns, reverse=True)
        except OSError:
            return []
        return found[:MAX_LISTED]

    def check(self, asked: Asked) -> Any:
        """Return the steps that a commissioning would do, or why it cannot be done."""
        return json.loads(self._golfbench.output(*self._arguments(*_wanted(asked))[1], "--check", "--json"))

    def start(self, asked: Asked) -> dict[str, Any]:
        """Begin a commissioning, or resume one."""
        wanted = _wanted(asked)
        asked.once()
        name, given = self._arguments(*wanted)
        self._command.start(name, *given)
        return {"note": f"{name}: the commissioning begins, on a simulated robot."}

    def stop(self, asked: Asked) -> dict[str, Any]:
        """End the process of a commissioning; the step under way is done again when it is resumed."""
        from bench.commissioning.commissioning import commissioning_process

        wanted = asked.text("name", MAX_FOLDER_LENGTH)
        asked.once()
        process = commissioning_process(self.folder(wanted))
        if process is None:
            expected = "a running commissioning"
            raise Refused("commissioning", "no process", expected, "Nothing is to be done.")
        with suppress(ProcessLookupError):  # it has just ended
            os.kill(process, signal.SIGTERM)
        return {"note": f"{wanted} ends. It can be resumed."}

    def file(self, path: Mapping[str, str]) -> Download | None:
        """Return the report of a commissioning as a page that can run nothing, or its robot as a file."""
        name, kind = path["commissioning"], path["kind"]
        try:
            found = plain_file(self.folder(name) / FILES[kind])
        except (Refused, KeyError):
            return None
        if found is None:
            return None
        if kind == "report":
            return Download(found, *REPORT)
        return Download.named(found, "application/toml", f"{name}.toml")

    def _arguments(self, robot: str, resumed: str, repaired: str) -> tuple[str, list[str]]:
        """Return name and arguments of a commissioning of `robot`; `resumed`: continue that one."""
        folder = self._folder / f"{self._bench}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
        if resumed:
            folder = self.folder(resumed)
        given = ["commission", "--sim", f"--output={folder}"]
        if robot:
            given.append(f"--robot={self.robot(robot)}")
        return folder.name, [*given, "--resume", f"--repaired={repaired}"] if resumed else given


def _commissioning(folder: Path) -> dict[str, Any]:
    """Return a commissioning for the page; one that cannot be read says why."""
    from bench.commissioning.commissioning import ALL_STEPS, commissioning_process, read_state

    named = {"name": folder.name, "process": commissioning_process(folder)}
    try:
        state = read_state(folder)
    except BenchError as error:
        return named | {"unreadable": str(error)}
    wrong, done = state.wrong, {step.name: step for step in state.done}
    return named | {
        "unreadable": "",
        "robot": Path(state.robot).stem if state.robot else "",
        "steps": [_step(step.title, done.get(step.name)) for step in ALL_STEPS],
        "done": len(state.done),
        "wrong": None if wrong is None else wrong._asdict(),
        "files": [kind for kind, file in FILES.items() if plain_file(folder / file) is not None],
    }


def _step(title: str, done: DoneStep | None) -> dict[str, Any]:
    """Return a step for the page; `done` is its result, None before it."""
    seconds, values, notes = (None, (), ()) if done is None else (done.seconds, done.values, done.notes)
    found = {"seconds": seconds, "values": len(values), "notes": list(notes)}
    return {"title": title, "done": done is not None} | found


def _wanted(asked: Asked) -> tuple[str, str, str]:
    """Return robot, resumed commissioning and repaired parts; empty: the configured one, a new one."""
    resumed = asked.text("resume", MAX_FOLDER_LENGTH, 0)
    repaired = asked.text("repaired", MAX_REPAIRED, 1 if resumed else 0)
    return asked.text("robot", MAX_FOLDER_LENGTH, 0), resumed, repaired
