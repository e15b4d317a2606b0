"""Files of the page, and files to download: named by a listing and by nothing else."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Self

_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


def static_files() -> dict[str, tuple[bytes, str]]:
    """Return content and media type of the files of the page by name."""
    folder = files("bench.web").joinpath("static")
    kinds = {file: _KINDS.get(Path(file.name).suffix) for file in folder.iterdir()}
    return {file.name: (file.read_bytes(), kind) for file, kind in kinds.items() if kind is not None}


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
        listed = [*islice(self._named(_names(self._records), search), MAX_RECORDS)]
        listed += islice(self._named(self._names_of_campaigns(), search), MAX_RECORDS)
        listed.sort(key=lambda one: one[1].st_mtime_ns, reverse=True)
        return [{"name": name, "bytes": about.st_size} for name, about in listed[:MAX_RECORDS]]

    def _names_of_campaigns(self) -> Iterator[str]:
        """Yield the names of the campaigns' swings, those of the latest campaigns first."""
        folders = [self._campaigns / name / "swings" for name in _names(self._campaigns)]
        for folder in sorted(filter(Path.is_dir, folders), key=lambda one: -one.stat().st_mtime_ns):
            yield from (f"{folder.parent.name}.{name}" for name in _names(folder))

    def _named(self, names: Iterable[str], search: str) -> Iterator[tuple[str, os.stat_result]]:
        for name in names:
            if search in name.casefold() and (path := self.record(name)) is not None:
                yield name, path.stat()

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
