"""The generated parts of the manual are those of the code, and every reader finds every page."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.manual import MANUAL, PARTS, page


@pytest.mark.parametrize("path", PARTS, ids=lambda path: path.name)
def test_page_of_generated_parts_is_current(path: Path) -> None:
    assert path.read_text() == page(path), "renew it: python -m tests.manual"


def test_index_of_the_manual_links_every_page() -> None:
    index = (MANUAL / "README.md").read_text()
    pages = (path.relative_to(MANUAL).as_posix() for path in MANUAL.rglob("*.md"))
    assert [name for name in pages if name != "README.md" and f"({name})" not in index] == []
