"""Requests of the page about commissionings: `golfbench commission --sim`, beside the page.

It measures a simulated robot in a process of its own. The running bench is not touched, and needs no lease.
"""

from __future__ import annotations

import json
import os
import signal
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

from bench.errors import Refused
from bench.page.answers import Asked
from bench.page.background_command import BackgroundCommand
from bench.page.command_line import CommandLine
from bench.page.commissioning_store import CommissioningStore
from bench.page.downloads import REPORT, Download

LONGEST_FOLDER = 121


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
        wanted = asked.text("name", LONGEST_FOLDER)
        asked.once()
        listed = self._shelf.view()["commissionings"]
        process = next((one["process"] for one in listed if one["name"] == wanted), None)
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
        """Return name and arguments of a commissioning of `robot`; `resumed`: go on with that one."""
        folder = self._shelf.folder(resumed) if resumed else self._shelf.new(datetime.now(UTC))
        given = ["commission", "--sim", f"--output={folder}"]
        if robot:
            given.append(f"--robot={self._shelf.robot(robot)}")
        return folder.name, [*given, "--resume"] if resumed else given


def _wanted(asked: Asked) -> tuple[str, str]:
    """Return the names of robot and resumed commissioning; empty: the configured one, a new one."""
    return asked.text("robot", LONGEST_FOLDER, 0), asked.text("resume", LONGEST_FOLDER, 0)
