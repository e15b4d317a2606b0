"""Files of the page, and files to download: named by a listing and by nothing else."""

from __future__ import annotations

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
    for file in files("bench.page").joinpath("static").iterdir():
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
        """Return name and size (bytes) of the newest records whose names have `search`."""
        try:
            names = sorted((path.name for path in self._records.iterdir()), reverse=True)
        except OSError:
            return []
        found = []
        for name in names:
            if search in name.casefold() and (path := self.record(name)) is not None:
                found.append({"name": name, "bytes": path.stat().st_size})
            if len(found) == MAX_RECORDS:
                break
        return found

    def newest(self) -> Path | None:
        """Return the newest record; None without one. Names begin with their times."""
        listed = self.records()
        return self.record(listed[0]["name"]) if listed else None

    def record(self, name: str) -> Path | None:
        """Return the record called `name`; None if it does not exist."""
        return plain_file(self._records / name) if _RECORD.fullmatch(name) else None

    def report(self, campaign: str) -> Path | None:
        """Return the report of `campaign`; None if it does not exist."""
        if not _CAMPAIGN.fullmatch(campaign):
            return None
        folder = self._campaigns / campaign
        return None if folder.is_symlink() else plain_file(folder / "report.html")


def plain_file(path: Path) -> Path | None:
    """Return `path` if it is a file itself, no link to one."""
    return path if path.is_file() and not path.is_symlink() else None
