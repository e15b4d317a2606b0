"""The files of the page, read once at the start: a request names one of them or nothing."""

from __future__ import annotations

from importlib.resources import files
from typing import NamedTuple

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
