"""Files of the page, and files to download: named by a listing and by nothing else."""

from __future__ import annotations

import os
import re
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, Self

_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".webmanifest": "application/manifest+json",
}


class StaticFile(NamedTuple):
    """Content and media type of one file."""

    content: bytes
    kind: str


def static_files() -> dict[str, StaticFile]:
    """Return the files of the page by name."""
    found = {}
    for file in files("bench.web").joinpath("static").iterdir():
        kind = _KINDS.get(f".{file.name.rpartition('.')[2]}")
        if kind is not None and file.is_file():
            found[file.name] = StaticFile(file.read_bytes(), kind)
    return found


MAX_RECORDS = 30
"""Max number of listed records."""
REPORT: tuple[str, dict[str, str]] = (
    "text/html; charset=utf-8",
    {
        "content-security-policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
        "font-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox"
    },
)
"""Media type and content policy of a report, a page with its own style and without scripts."""

_RECORD = re.compile(r"[0-9TZ]{8,40}-[0-9]{1,12}\.parquet")
_CAMPAIGN = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,120}")
_SHOT = re.compile(r"(?P<campaign>[A-Za-z0-9][A-Za-z0-9._-]{0,120})\.(?P<file>[0-9]{1,12}\.parquet)")


class Download(NamedTuple):
    """A file for a browser."""

    path: Path
    kind: str
    """Media type."""
    headers: dict[str, str]

    @classmethod
    def named(cls, path: Path, kind: str, name: str) -> Self:
        """Return one that is stored under `name`, not shown."""
        return cls(path, kind, {"content-disposition": f'attachment; filename="{name}"'})


class Downloads:
    """The files of one bench below its data folder."""

    def __init__(self, data_dir: Path, bench: str) -> None:
        self._records, self._campaigns = data_dir / "swings" / bench, data_dir / "campaigns"

    def records(self, search: str = "") -> list[dict[str, Any]]:
        """Return name and size (bytes) of the newest records, campaigns' too, whose names have `search`."""
        listed = [*self._own(search), *self._of_campaigns(search)]
        listed.sort(key=lambda one: one[1].st_mtime_ns, reverse=True)
        return [{"name": name, "bytes": about.st_size} for name, about in listed[:MAX_RECORDS]]

    def _own(self, search: str) -> list[tuple[str, os.stat_result]]:
        """Return the newest swings outside of campaigns; names begin with their times."""
        return self._listed(_names(self._records), search)

    def _of_campaigns(self, search: str) -> list[tuple[str, os.stat_result]]:
        """Return the newest swings of campaigns: those of the latest ones, named after them."""
        found = list[tuple[str, os.stat_result]]()
        folders = [self._campaigns / name / "swings" for name in _names(self._campaigns)]
        for folder in sorted(filter(Path.is_dir, folders), key=lambda one: -one.stat().st_mtime_ns):
            named = [f"{folder.parent.name}.{name}" for name in _names(folder)]
            found += self._listed(named, search)
            if len(found) >= MAX_RECORDS:
                break
        return found

    def _listed(self, names: list[str], search: str) -> list[tuple[str, os.stat_result]]:
        found = list[tuple[str, os.stat_result]]()
        for name in names:
            if search in name.casefold() and (path := self.record(name)) is not None:
                found.append((name, path.stat()))
            if len(found) == MAX_RECORDS:
                break
        return found

    def newest(self) -> Path | None:
        """Return the newest record; None without one."""
        listed = self.records()
        return self.record(listed[0]["name"]) if listed else None

    def record(self, name: str) -> Path | None:
        """Return the record called `name`, of a campaign CAMPAIGN.FILE; None if it does not exist."""
        if _RECORD.fullmatch(name):
            return plain_file(self._records / name)
        if (parts := _SHOT.fullmatch(name)) is None:
            return None
        folder = self._campaigns / parts["campaign"]
        return None if folder.is_symlink() else plain_file(folder / "swings" / parts["file"])

    def report(self, campaign: str) -> Path | None:
        """Return the report of `campaign`; None if it does not exist."""
        if not _CAMPAIGN.fullmatch(campaign):
            return None
        folder = self._campaigns / campaign
        return None if folder.is_symlink() else plain_file(folder / "report.html")


def _names(folder: Path) -> list[str]:
    """Return the names in `folder`, the last ones first; none where it cannot be read."""
    try:
        return sorted((path.name for path in folder.iterdir()), reverse=True)
    except OSError:
        return []


def plain_file(path: Path) -> Path | None:
    """Return `path` if it is a file itself, no link to one."""
    return path if path.is_file() and not path.is_symlink() else None
