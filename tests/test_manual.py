"""The manual's generated parts and example are those of the code, and every reader finds every page."""

from __future__ import annotations

import runpy
from pathlib import Path

import numba
import pytest

from tests.manual import MANUAL, PARTS, page
from tests.site.conf import navigation


@pytest.mark.parametrize("path", PARTS, ids=lambda path: path.name)
def test_manual_generated_page_is_current(path: Path) -> None:
    assert path.read_text() == page(path), "renew it: python -m tests.manual"


def test_site_navigation_names_every_page_once() -> None:
    named = [path for pages in navigation().values() for _, path in pages]
    pages = (path.relative_to(MANUAL).as_posix() for path in MANUAL.rglob("*.md"))
    assert sorted(named) == sorted(name for name in pages if name != "README.md")


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="a swing takes a minute without compilation")
def test_manual_example_swings_and_plots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    found = runpy.run_path(str(MANUAL / "test_engineer" / "swing_from_python.py"))
    assert found["cycles"]["head_speed"].max() > 40.0
    assert (tmp_path / "swing.png").stat().st_size > 5000
