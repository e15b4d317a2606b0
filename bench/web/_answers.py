"""Requests of a browser and the page's answers: JSON, the page's own files, and files to download.

Requests name files to download as listings do, in no other way.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from bench.base.errors import BenchError
from bench.base.json_schema import json_object
from bench.network.client import CommandRefused
from bench.network.status_words import sentence
from bench.network.zenoh_session import NoAnswer

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

MAX_NAME_LENGTH = 64
"""Max length of a person's name, characters."""


class InvalidBody(Exception):
    """A request with a body that the page does not send."""


class UnknownName(Exception):
    """A request whose path names nothing that there is."""


class Asked(NamedTuple):
    """A request of a reader whose role allows it."""

    path: Mapping[str, str]
    """Names in its path."""
    body: dict[str, Any]
    ticket: str
    """Ticket of the tab's lease; empty: none."""
    check: Callable[[str, float | None], None]
    """Takes each number once, as `CommandNumbers.check`."""

    def text(self, name: str, longest: int = MAX_NAME_LENGTH, shortest: int = 1) -> str:
        """Return the text `name` of the body; raises as `text_in`."""
        return text_in(self.body, name, longest, shortest)

    def number(self, name: str) -> float:
        """Return the number `name` of the body; raises as `number_in`."""
        return number_in(self.body, name)

    def units(self) -> str:
        """Return the reader's units, "si" or "us"; raises InvalidBody if they are neither."""
        if (units := self.body.get("units")) not in ("si", "us"):
            raise InvalidBody("units: si or us")
        return str(units)

    def once(self, *, fresh: bool = False) -> None:
        """Refuse a repeated request; with `fresh` also one from an outdated screen.

        Raises:
            InvalidBody: it has no number; `fresh`: or no time.
            Refused: as `CommandNumbers.check`.
        """
        self.check(self.text("number", 64, 8), self.number("seen") if fresh else None)


def json_answer(content: Any, status: int = 200) -> Response:
    """Return `content` as a response."""
    from starlette.responses import Response

    return Response(json.dumps(content, allow_nan=False), status, media_type="application/json")


def refusal_answer(error: BenchError) -> Response:
    """Return `error` in the operator's words: `what` was found, and the `action`."""
    if isinstance(error, CommandRefused):
        what, action = sentence(error.answer.reason), sentence(error.answer.action)
        return json_answer({"what": what, "action": action or "Look at the state of the bench."}, 409)
    if isinstance(error, NoAnswer):
        what = "The bench does not answer: it is unknown whether the command arrived."
        return json_answer(
            {"what": what, "action": "Look at the robot. No command is repeated automatically."}, 504
        )
    what = f"{error.location}: {error.found}; expected {error.expected}."
    return json_answer({"what": f"{what[:1].upper()}{what[1:]}", "action": error.action}, 409)


async def body_of(request: Request) -> dict[str, Any]:
    """Return the JSON object in the body of `request`, whose length the request filter has checked.

    Raises:
        InvalidBody: it is no object, or the connection ended before all of it had arrived.
    """
    from starlette.requests import ClientDisconnect

    try:
        body = await request.body()
    except ClientDisconnect:
        raise InvalidBody("cut off") from None
    if (read := json_object(body)) is None:
        raise InvalidBody("no JSON object")
    return read


def text_in(body: dict[str, Any], name: str, longest: int, shortest: int = 1) -> str:
    """Return the text `name` of `body`, without surrounding blanks.

    Raises:
        InvalidBody: it is missing, no text, of invalid length, or has control characters.
    """
    value = body.get(name)
    if not isinstance(value, str) or not shortest <= len(value.strip()) <= longest:
        raise InvalidBody(f"{name}: a text of {shortest} to {longest} characters")
    if not value.strip().isprintable():
        raise InvalidBody(f"{name}: printable characters only")
    return value.strip()


def number_in(body: dict[str, Any], name: str) -> float:
    """Return the finite number `name` of `body`; raises InvalidBody: it is missing or no such number."""
    value = body.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e15:
        raise InvalidBody(f"{name}: a number")
    return float(value)


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
REPORT: tuple[str, dict[str, str]] = (
    "text/html; charset=utf-8",
    {
        "content-security-policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
        "font-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox"
    },
)
"""Media type and content policy of a report, a page with its own style and without scripts."""

_RECORD = re.compile(r"[0-9TZ]{8,40}-[0-9]{1,12}\.parquet")
PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,120}")
"""Names of campaigns and commissionings, as folders have them."""
_SHOT = re.compile(rf"(?P<campaign>{PLAIN_NAME.pattern})\.(?P<file>[0-9]{{1,12}}\.parquet)")


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
        if not PLAIN_NAME.fullmatch(campaign):
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
