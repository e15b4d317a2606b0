"""Findings of `golfbench wear` are stored for the status of their bench, or the reason is reported."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.base.errors import Refused
from bench.commands.machine.wear import _store
from bench.supervisor.status import read_wear, wear_file

LATER, EARLIER = "2026-01-02T00:00:00", "2026-01-01T00:00:00"


@pytest.mark.parametrize(
    ("benches", "until", "found"),
    [
        (["b2"], LATER, "b2"),
        (["b1", "b2"], LATER, "b1, b2"),
        (["b1"], EARLIER, f"until {EARLIER}"),
    ],
    ids=["another bench", "two benches", "earlier swings"],
)
def test_wear_findings_not_stored_report_reason(
    tmp_path: Path, benches: list[str], until: str, found: str
) -> None:
    _store(tmp_path, "b1", ["b1"], LATER, {"wrist valve": "worn"})
    with pytest.raises(Refused, match="not stored") as refused:
        _store(tmp_path, "b1", benches, until, {})
    assert refused.value.found == f"swings {'' if until == EARLIER else 'of '}{found}"
    stored = read_wear(wear_file(tmp_path, "b1"))
    assert (stored.time_utc, [one["part"] for one in stored.findings]) == (LATER, ["wrist valve"])
