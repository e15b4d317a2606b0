"""The search: the grid's plans, single parts made cheaper around the cheapest that will do, then swings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from bench.config import load_configuration
from bench.simulation.code_version import code_digest
from bench.simulation.sweep import Engine, sweep
from bench.simulation.sweep_store import SweepStore
from bench.sizing.candidates import SizingGrid, cheaper, without_repeats
from bench.sizing.catalogue import Catalogue
from bench.sizing.hardware import Hardware, parts_of
from bench.sizing.point import SizedPlan, SizedPoint, SizedSwing, as_json, non_dominated, plan_of, swing_of
from bench.sizing.study import PlanStudy, SizingDemand, SwingStudy

Shown = Callable[[str, int, int], None]
"""Gets the step, how many of its cases are done, and of how many."""


@dataclass(frozen=True)
class SizingSearch:
    """How far to search."""

    grid: SizingGrid
    rounds: int = 2
    """Rounds of cheaper parts around the cheapest candidate that will do."""
    swings: int = 1
    """Number of candidates whose whole swing is designed."""
    spacing: int = 0
    """Ticks between the instants at which faults are tried with them; 0: none."""


class SizingRun:
    """One search in a folder of results, which it goes on from."""

    def __init__(
        self,
        catalogue: Catalogue,
        demand: SizingDemand,
        folder: Path,
        engine: Engine,
        show: Shown = lambda step, done, total: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Open the results in `folder`; those of another catalogue, demand, code or plant are dropped."""
        self.catalogue, self.demand, self.folder = catalogue, demand, folder
        self._engine, self._show, self._stop = engine, show, stop
        folder.mkdir(parents=True, exist_ok=True)
        digest = _digest(catalogue, demand)
        self._plans = SweepStore[SizedPlan](folder / "plans.jsonl", digest, as_json, plan_of)
        self._digest = digest

    @property
    def seconds(self) -> float:
        """Time that the plans took over all runs, s."""
        return self._plans.seconds

    def points(self, search: SizingSearch) -> list[SizedPoint]:
        """Return what was found, in the order of price; less when a stop was asked for."""
        tried = search.grid.candidates(self.catalogue)
        points = self._planned("plans of the grid", tried)
        for count in range(search.rounds):
            best = self._cheapest(points)
            if best is None or self._stop():
                break
            new = without_repeats(cheaper(self.catalogue, best.hardware), tried)
            if not new:
                break
            tried += new
            points += self._planned(f"cheaper parts, round {count + 1}", new)
        points.sort(key=lambda point: (point.price, -point.plan.speed))
        return self._swung(points, search)

    def _planned(self, step: str, candidates: Sequence[Hardware]) -> list[SizedPoint]:
        sweep(
            PlanStudy(self.catalogue, self.demand),
            candidates,
            self._engine,
            store=self._plans,
            key=lambda hardware: hardware.name,
            progress=lambda done: self._show(step, done, len(candidates)),
            stop=self._stop,
        )
        kept = self._plans.results
        return [
            SizedPoint(hardware, parts_of(self.catalogue, hardware).price, kept[hardware.name])
            for hardware in candidates
            if hardware.name in kept
        ]

    def _cheapest(self, points: Sequence[SizedPoint]) -> SizedPoint | None:
        """Return the cheapest point that exceeds the speed by the reserve, the fastest of equal prices."""
        enough = self.enough(points)
        return min(enough, key=lambda point: (point.price, -point.plan.speed), default=None)

    def enough(self, points: Sequence[SizedPoint]) -> list[SizedPoint]:
        """Return the points whose plan exceeds the demanded speed by the reserve."""
        least = self.demand.speed * (1.0 + self.demand.reserve)
        return [point for point in points if point.plan.speed >= least]

    def _swung(self, points: list[SizedPoint], search: SizingSearch) -> list[SizedPoint]:
        chosen = [point.hardware for point in non_dominated(self.enough(points))[: search.swings]]
        if not chosen or self._stop():
            return points
        file = self.folder / f"swings-{search.spacing}.jsonl"
        store = SweepStore[SizedSwing](file, self._digest, as_json, swing_of)
        sweep(
            SwingStudy(self.catalogue, self.demand, search.spacing, self.folder),
            chosen,
            self._engine,
            store=store,
            key=lambda hardware: hardware.name,
            progress=lambda done: self._show("whole swings", done, len(chosen)),
            stop=self._stop,
        )
        return [replace(point, swing=store.results.get(point.hardware.name)) for point in points]


def _digest(catalogue: Catalogue, demand: SizingDemand) -> str:
    """Return the digest of all that plans and swings depend on."""
    shipped = load_configuration(Path("shipped"))
    settings = [asdict(shipped.plant), asdict(shipped.control), asdict(shipped.envelope)]
    text = json.dumps(
        [asdict(catalogue), asdict(demand), settings, asdict(shipped.estimator)], default=str, sort_keys=True
    )
    return hashlib.sha256(f"{code_digest('bench.sizing.study')} {text}".encode()).hexdigest()[:16]
