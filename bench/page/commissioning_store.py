"""Commissionings for the page, as `golfbench commission` stores them, and the robots it may simulate.

Each has a folder in `commissioning` beside the bench's records; robots other than the configured one are
configurations in the folder `robots` there. A request names what is listed and nothing else.
"""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.commissioning.commissioning import ALL_STEPS, STATE_FILE, Commissioning, read_state
from bench.commissioning.folder_lock import commissioning_process
from bench.errors import BenchError, Refused
from bench.page.downloads import plain_file
from bench.page.plan_catalogue import is_toml_to_name

MAX_LISTED = 10
"""Max number of listed commissionings."""
MAX_ROBOTS = 100
FILES = {"report": "report.html", "robot": "robot.toml"}
"""Files of a commissioning by their names on the page."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,120}")


class CommissioningStore:
    """The commissionings of one bench."""

    def __init__(self, data_dir: Path, bench: str) -> None:
        self._folder, self._robots, self._bench = data_dir / "commissioning", data_dir / "robots", bench

    def view(self) -> dict[str, Any]:
        """Return steps, robots and commissionings, the newest first, as the page shows them."""
        return {
            "steps": [{"title": step.title, "bounds": step.bounds_text} for step in ALL_STEPS],
            "robots": [path.stem for path in self._robot_files()],
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
        for path in self._folders():
            if path.name == name:
                return path
        raise Refused("commissioning", "an unknown name", "one of the listed ones", "Load the page again.")

    def robot(self, name: str) -> Path:
        """Return the file of the robot called `name`.

        Raises:
            Refused: no such robot is listed.
        """
        for path in self._robot_files():
            if path.stem == name:
                return path
        cure = f"Put its configuration into {self._robots}."
        raise Refused("robot", "an unknown name", "one of the listed ones", cure)

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

    def _robot_files(self) -> list[Path]:
        try:
            found = sorted(self._robots.glob("*.toml"))[:MAX_ROBOTS]
        except OSError:
            return []
        return [path for path in found if is_toml_to_name(path)]


def _is_one(path: Path) -> bool:
    plain = bool(_NAME.fullmatch(path.name)) and not path.is_symlink()
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
