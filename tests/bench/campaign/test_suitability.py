"""Needs of a plan on a running bench, and what in its configuration does not suit the plan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bench.campaign.plan_file import load_plan
from bench.campaign.suitability import free_space, needs, needs_words, unsuitable
from bench.config import load_configuration

SHIPPED = load_configuration(Path("shipped"))


def test_disk_and_work_by_hand_are_known_before_anything_moves(tmp_path: Path) -> None:
    plan = load_plan(Path("clubs"), SHIPPED)
    plan = replace(plan, ball_handling=replace(plan.ball_handling, magazine=10))
    found = needs(plan)
    assert found.bytes == 36 * 1_400_000
    assert (found.feeder_fills, found.hand_work) == (4, 180.0 * found.club_changes + 480.0)
    assert found.club_changes > 20
    assert "Not enough" in needs_words(plan, 1_000_000)[0]
    assert "Not enough" not in needs_words(plan, 10**9)[0]
    assert free_space(tmp_path / "not" / "there") > 0


def test_a_bench_that_vents_between_swings_does_not_suit_a_narrow_gate() -> None:
    plan = load_plan(Path("two-balls"), SHIPPED)

    def told(series: bool, gate: float) -> list[str]:
        configuration = replace(SHIPPED, lifecycle=replace(SHIPPED.lifecycle, series=series))
        return list(unsuitable(replace(plan, gate=replace(plan.gate, club_speed=gate)), configuration))

    (text,) = told(False, 1.0)
    assert "Set [lifecycle] series = true" in text
    assert not told(True, 1.0)
    assert not told(False, 2.5)
    assert not told(False, 0.0)
