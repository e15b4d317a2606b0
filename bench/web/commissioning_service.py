"""Requests of the page about commissionings: `golfbench commission --sim`, run by the page.

It measures a simulated robot in a separate process. The running bench is not affected, and needs no lease.
Each commissioning has a folder in `commissioning` next to the bench's records; robots other than the
configured one are configurations in the folder `robots` there. A request names only listed entries.
"""

from __future__ import annotations

import json
import os
import signal
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.base.errors import BenchError, Refused
from bench.commissioning.commissioning import (
    ALL_STEPS,
    STATE_FILE,
    Commissioning,
    commissioning_process,
    read_state,
)
from bench.web.answers import PLAIN_NAME, REPORT, Asked, Download, plain_file
from bench.web.command_line import BackgroundCommand, CommandLine
from bench.web.start_service import listed_file, toml_files

MAX_LISTED = 10
"""Max number of listed commissionings."""
FILES = {"report": "report.html", "robot": "robot.toml"}
"""Files of a commissioning by their names on the page."""


class CommissioningStore:
    """The commissionings of one bench."""

    def __init__(self, data_dir: Path, bench: str) -> None:
        self._folder, self._robots, self._bench = data_dir / "commissioning", data_dir / "robots", bench

    def view(self) -> dict[str, Any]:
        """Return steps, robots and commissionings, the newest first, as the page shows them."""
        return {
            "steps": [{"title": step.title, "bounds": step.bounds_text} for step in ALL_STEPS],
            "robots": list(toml_files(self._robots)),
            "folder": str(self._robots),
            "commissionings": [_described(folder) for folder in self._folders()],
        }

    def new(self, now: datetime) -> Path:
        """Return the folder of a commissioning that begins `now`."""
        return self._folder / f"{self._bench}-{now:%Y%m%dT%H%M%SZ}"

    def folder(self, name: str) -> Path:
        """Return the folder of the commissioning called `name`.

        Raises:
            Refused: no such commissioning is listed.
        """
        listed = {path.name: path for path in self._folders()}
        return listed_file("commissioning", listed, name, "Load the page again.")

    def robot(self, name: str) -> Path:
        """Return the file of the robot called `name`.

        Raises:
            Refused: no such robot is listed.
        """
        action = f"Put its configuration into {self._robots}."
        return listed_file("robot", toml_files(self._robots), name, action)

    def file(self, name: str, kind: str) -> Path | None:
        """Return the file `kind` of FILES of commissioning `name`; None if it does not exist."""
        found = FILES.get(kind)
        try:
            return None if found is None else plain_file(self.folder(name) / found)
        except Refused:
            return None

    def _folders(self) -> list[Path]:
        try:
            found = [path for path in self._folder.iterdir() if _is_one(path)]
            found.sort(key=lambda path: (path / STATE_FILE).stat().st_mtime_ns, reverse=True)
        except OSError:
            return []
        return found[:MAX_LISTED]


def _is_one(path: Path) -> bool:
    plain = bool(PLAIN_NAME.fullmatch(path.name)) and not path.is_symlink()
    return plain and plain_file(path / STATE_FILE) is not None


def _described(folder: Path) -> dict[str, Any]:
    """Return a commissioning for the page; one that cannot be read says why."""
    named = {"name": folder.name, "process": commissioning_process(folder)}
    try:
        state = read_state(folder)
    except BenchError as error:
        return named | {"unreadable": str(error)}
    wrong = state.wrong
    return named | {
        "unreadable": "",
        "robot": Path(state.robot).stem if state.robot else "",
        "steps": _steps(state),
        "done": len(state.done),
        "wrong": None if wrong is None else wrong._asdict(),
        "files": [kind for kind, file in FILES.items() if plain_file(folder / file) is not None],
    }


def _steps(state: Commissioning) -> list[dict[str, Any]]:
    """Return what each step found, in the order of the steps."""
    done = {step.name: step for step in state.done}
    found = []
    for step in ALL_STEPS:
        one = done.get(step.name)
        found.append(
            {
                "title": step.title,
                "done": one is not None,
                "seconds": None if one is None else one.seconds,
                "values": 0 if one is None else len(one.values),
                "notes": [] if one is None else list(one.notes),
            }
        )
    return found


MAX_FOLDER_LENGTH = 121


class CommissioningService:
    """Checks, starts and ends of commissionings, and their files."""

    def __init__(self, golfbench: CommandLine, shelf: CommissioningStore, command: BackgroundCommand) -> None:
        self._golfbench, self._shelf, self._command = golfbench, shelf, command

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
        wanted = asked.text("name", MAX_FOLDER_LENGTH)
        asked.once()
        process = commissioning_process(self._shelf.folder(wanted))
        if process is None:
            expected = "a running commissioning"
            raise Refused("commissioning", "no process", expected, "Nothing is to be done.")
        with suppress(ProcessLookupError):  # it has just ended
            os.kill(process, signal.SIGTERM)
        return {"note": f"{wanted} ends. It can be resumed."}

    def file(self, path: dict[str, str]) -> Download | None:
        """Return the report of a commissioning as a page that can run nothing, or its robot as a file."""
        name, kind = path["commissioning"], path["kind"]
        if (found := self._shelf.file(name, kind)) is None:
            return None
        if kind == "report":
            return Download(found, *REPORT)
        return Download.named(found, "application/toml", f"{name}.toml")

    def _arguments(self, robot: str, resumed: str) -> tuple[str, list[str]]:
        """Return name and arguments of a commissioning of `robot`; `resumed`: continue that one."""
        folder = self._shelf.folder(resumed) if resumed else self._shelf.new(datetime.now(UTC))
        given = ["commission", "--sim", f"--output={folder}"]
        if robot:
            given.append(f"--robot={self._shelf.robot(robot)}")
        return folder.name, [*given, "--resume"] if resumed else given


def _wanted(asked: Asked) -> tuple[str, str]:
    """Return the names of robot and resumed commissioning; empty: the configured one, a new one."""
    return asked.text("robot", MAX_FOLDER_LENGTH, 0), asked.text("resume", MAX_FOLDER_LENGTH, 0)
