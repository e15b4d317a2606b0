"""Pages of campaigns without the drawing of their pictures, which takes most of the time of a report."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

import bench.campaign.report.campaign_plots


@contextmanager
def _undrawn() -> Iterator[None]:
    def placed(_: Any, name: str) -> str:
        return f'<svg aria-hidden="true" focusable="false" id="{name}"><path d="M 0.0 0.0"/></svg>'

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench.campaign.report.campaign_plots, "to_svg", placed)
        yield


@pytest.fixture(scope="module")
def undrawn() -> Iterator[None]:
    """Leave an empty picture in each place, for all tests of a file."""
    with _undrawn():
        yield


@pytest.fixture
def undrawn_here() -> Iterator[None]:
    """Leave an empty picture in each place, for one test."""
    with _undrawn():
        yield
