"""Pages of campaigns without the drawing of their pictures."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import bench.campaign.campaign_plots


@pytest.fixture(scope="module")
def undrawn() -> Iterator[None]:
    """Leave a picture's place on each page: drawing them takes most of the time of a report."""
    picture = '<svg aria-hidden="true" focusable="false" id="{}"><path d="M 0.0 0.0"/></svg>'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench.campaign.campaign_plots, "to_svg", lambda figure, name: picture.format(name))
        yield
