"""The site of the manual, built by Sphinx: `make manual`. The table of its README is the navigation."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

MANUAL = Path(__file__).resolve().parents[2] / "bench/manual"

project = "golfbench"
extensions = ["myst_parser"]
root_doc = "bench/manual/README"
include_patterns = [
    "README.md",
    "bench/**.md",
    "sim/*.md",
    "drivers/**.md",
    "systemd/*.md",
    "tests/**.md",
    ".github/**.md",
]
myst_heading_anchors = 3
html_theme = "furo"
html_title = "golfbench manual"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_use_index = False
html_copy_source = False
html_show_copyright = False


def navigation() -> dict[str, list[tuple[str, str]]]:
    """Return title and path of the pages by reader, in the order of the table."""
    rows = re.findall(r"^\| ([\w ]+) \| (.*\.md\).*) \|$", (MANUAL / "README.md").read_text(), re.MULTILINE)
    return {reader: re.findall(r"\[(.+?)\]\((.+?\.md)\)", pages) for reader, pages in rows}


def setup(app: Any) -> None:
    """Connect the hooks of the build to `app`, the Sphinx application."""
    app.connect("source-read", _add_navigation)
    app.connect("build-finished", _add_start_page)


def _add_navigation(app: Any, document: str, source: list[str]) -> None:
    if document == root_doc:
        source[0] += "".join(
            _contents(reader, [f"{title[0].upper()}{title[1:]} <{path}>" for title, path in pages])
            for reader, pages in navigation().items()
        )
        source[0] += _contents("project", ["Project <../../README>"])
    elif document == "README":
        others = [
            one for one in sorted(app.env.found_docs) if not one.startswith((document, "bench/manual/"))
        ]
        source[0] += _contents("documents", [f"/{one}" for one in others])


def _contents(caption: str, entries: list[str]) -> str:
    """Return a part of the navigation, which the page itself does not show."""
    head = ["```{toctree}", ":hidden:", f":caption: {caption[0].upper()}{caption[1:]}", ""]
    return "\n".join(["\n", *head, *entries, "```\n"])


def _add_start_page(app: Any, exception: Exception | None) -> None:
    """Write the start page of the site, which leads to the manual's first page."""
    if exception is None:
        page = f'<!doctype html><meta http-equiv="refresh" content="0; url={root_doc}.html">\n'
        (Path(app.outdir) / "index.html").write_text(page)
