"""The search: front, cheaper parts around the cheapest, results that are reused, stops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pytest

from bench.design.sizing import search as module
from bench.design.sizing.catalogue import Hardware, parts_of, shipped_catalogue
from bench.design.sizing.search import (
    SizedPlan,
    SizedPoint,
    SizedSwing,
    SizingDemand,
    SizingGrid,
    SizingRun,
    SizingSearch,
    draw_front,
    non_dominated,
    plan_of,
)
from bench.simulation.sweep import InProcess

PARTS = shipped_catalogue()
ASKED: list[str] = []


def speed_of(hardware: Hardware) -> float:
    """Return a made-up speed that grows with the vane and the shoulder's valve only."""
    parts = parts_of(PARTS, hardware)
    return 32.0 + 4e4 * parts.vane.displacement + 2e-3 * parts.valves[0].nominal_flow


@dataclass(frozen=True)
class Plans:
    """Stands for PlanStudy."""

    catalogue: Any
    demand: Any

    def prepared(self) -> Callable[[Hardware], SizedPlan]:
        def plan(hardware: Hardware) -> SizedPlan:
            ASKED.append(hardware.name)
            return SizedPlan(speed_of(hardware), "", (1.0, 2.0), 9e5, (("time", 0.1),))

        return plan


@dataclass(frozen=True)
class Swings:
    """Stands for SwingStudy."""

    catalogue: Any
    demand: Any
    spacing: int
    folder: Path

    def prepared(self) -> Callable[[Hardware], SizedSwing]:
        return lambda hardware: SizedSwing(58.1, "", 0.0, 0.04, 9e5, 0.2, 0.6, 0.6, self.spacing, 1, 2)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace what takes minutes."""
    monkeypatch.setattr(module, "PlanStudy", Plans)
    monkeypatch.setattr(module, "SwingStudy", Swings)
    ASKED.clear()


def run(folder: Path, search: SizingSearch, **more: Any) -> list[SizedPoint]:
    return SizingRun(PARTS, SizingDemand(), folder, InProcess(), **more).points(search)


def test_non_dominated_returns_front() -> None:
    def point(price: int, speed: float, failure: str = "") -> SizedPoint:
        return SizedPoint(Hardware(), price, SizedPlan(speed, failure))

    found = non_dominated(
        [point(3, 60), point(1, 50), point(2, 49), point(3, 61), point(4, float("nan"), "no")]
    )
    assert [(p.price, p.plan.speed) for p in found] == [(1, 50), (3, 61)]


def test_sizing_run_rounds_find_cheapest_sufficient_parts(tmp_path: Path) -> None:
    points = run(tmp_path, SizingSearch(SizingGrid(), rounds=12, swings=1))
    enough = [p for p in points if p.plan.speed >= 58.1 * 1.05]
    swung = [p for p in points if p.swing is not None]
    assert [p.price for p in swung] == [min(p.price for p in enough)]
    # Only the vane and the shoulder's valve matter here, so all other parts are of the least price.
    least = {
        kind: min(part.price for part in getattr(PARTS, kind).values()) for kind in ("cylinders", "valves")
    }
    best = swung[0].hardware
    assert PARTS.cylinders[best.arm].price == least["cylinders"]
    assert PARTS.valves[best.wrist_valve].price == least["valves"]


def test_sizing_run_reuses_results(tmp_path: Path) -> None:
    search = SizingSearch(SizingGrid(), rounds=2)
    first = run(tmp_path, search)
    assert len(ASKED) == len(set(ASKED)) == len(first)
    assert run(tmp_path, search) == first
    assert len(ASKED) == len(first)


def test_sizing_run_stop_leaves_rest_for_next_run(tmp_path: Path) -> None:
    search = SizingSearch(SizingGrid(), rounds=1)
    early = run(tmp_path, search, stop=lambda: len(ASKED) >= 3)
    assert 3 <= len(early) < 32
    assert all(point.swing is None for point in early)
    whole = run(tmp_path, search)
    assert len(ASKED) == len(set(ASKED)) == len(whole)


def test_plan_of_stored_record_returns_plan() -> None:
    plan = SizedPlan(60.0, "", (1.0, 2.0), 9e5, (("time", 0.1),))
    assert plan_of(asdict(plan)) == plan


def test_draw_front_writes_picture(tmp_path: Path) -> None:
    points = run(tmp_path, SizingSearch(SizingGrid()))
    draw_front(points, 58.1, tmp_path / "front.png")
    assert (tmp_path / "front.png").stat().st_size > 10_000
