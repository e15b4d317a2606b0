from __future__ import annotations

from tests.benchmarks.launch_monitor_fuzz import fuzz, rows_of


def test_launch_monitor_fuzz_holds_all_limits() -> None:
    result = fuzz(3000, 1)
    for row in rows_of(result, "fuzz"):
        assert row.holds, row
    assert result.link is not None
    counts = result.link.counts
    assert min(counts.shots, counts.statuses, counts.refused, counts.cut_off, counts.passed_over) > 10
