"""A short campaign in real time with all that disturbs one; the long one is a benchmark."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.campaign_show import rows_of, show

pytestmark = [pytest.mark.live, pytest.mark.paced, pytest.mark.release]


@pytest.mark.timeout(900)  # the first start compiles
def test_what_was_planned_is_there_in_the_end_and_what_went_wrong_on_record(tmp_path: Path) -> None:
    result = show(tmp_path, 4, (1,), (1, 2, 4), 8.0, "paced")
    missed = [row for row in rows_of(result, "four shots", 1) if not row.holds]
    assert not missed, result.output
    # Two different balls lay on the simulated tee: the monitor saw what the plant struck.
    varied = [metadata["varied"] for metadata in result.metadata]
    assert {one["struck_in_the_plant"] for one in varied} == {"tour", "range"}
    assert all(metadata["launch"]["device"] for metadata in result.metadata if "launch" in metadata)
