"""The search: a coarse grid, single parts made cheaper around the cheapest that will do, then swings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import matplotlib as mpl

from bench.config import load_configuration
from bench.design.sizing.catalogue import Catalogue
from bench.design.sizing.hardware import KINDS, Hardware, parts_of
from bench.design.sizing.study import (
    PlanStudy,
    SizedPlan,
    SizedPoint,
    SizedSwing,
    SizingDemand,
    SwingStudy,
    non_dominated,
    plan_of,
    swing_of,
)
from bench.records.shot.plot_style import COLOURS, GREY, STYLE, save_picture, styled
from bench.simulation.sweep import Engine, SweepStore, code_digest, sweep

_SMALL_FEED = 2.6e-7
"""Conductance of the three valves up to which the shipped feed and manifold serve, m3/(s Pa)."""


@dataclass(frozen=True)
class SizingGrid:
    """The coarse grid; both cylinders and all valves are alike in it, cheaper parts come one by one."""

    vanes: tuple[str, ...] = ("V400", "V600")
    cylinders: tuple[str, ...] = ("C50", "C63")
    valves: tuple[str, ...] = ("F2000", "F3500")
    absorbers: tuple[tuple[str, str], ...] = (("A40", "A90"), ("A120", "A170"))
    """Pairs of absorbers: right arm's and wrist's."""
    pressures: tuple[float, ...] = (8.0e5, 10.0e5)
    """Supply pressures (Pa absolute)."""
    levers: tuple[float, ...] = (0.06,)
    """Levers of the wrist (m)."""
    lever_angles: tuple[float, ...] = (0.0,)
    """Mounting angles of the lever, rad."""
    frames: tuple[str, ...] = ("R80",)
    hoses: tuple[str, ...] = ("",)
    vents: tuple[str, ...] = ("",)

    def candidates(self, catalogue: Catalogue) -> list[Hardware]:
        """Return all combinations; feed and manifold follow the valves.

        Raises:
            BenchError: the catalogue has no part of a name.
        """
        found = []
        parts = product(self.vanes, self.cylinders, self.valves, self.absorbers)
        free = list(
            product(self.pressures, self.levers, self.lever_angles, self.frames, self.hoses, self.vents)
        )
        for (vane, bore, valve, (arm, wrist)), freely in product(parts, free):
            made = Hardware(vane, bore, bore, valve, valve, valve, arm, wrist, "L34", "M2", *freely)
            flow = sum(part.conductance for part in parts_of(catalogue, made).valves)
            found.append(made if flow <= _SMALL_FEED else replace(made, feed="L100", manifold="M5"))
        return found


def cheaper(catalogue: Catalogue, hardware: Hardware) -> list[Hardware]:
    """Return `hardware` with one part each replaced by the largest smaller one of a lower price class."""
    found = []
    for field, kind in KINDS.items():
        parts, own = getattr(catalogue, kind), getattr(hardware, field)
        if field == "frame" or not own:  # a frame has no price
            continue
        below = list(parts)[: list(parts).index(own)]
        less = [name for name in below if parts[name].price < parts[own].price]
        if less:
            found.append(replace(hardware, **{field: less[-1]}))
    return found


def without_repeats(found: Sequence[Hardware], known: Sequence[Hardware]) -> list[Hardware]:
    """Return those of `found` that are not in `known`, each once."""
    return [hardware for hardware in dict.fromkeys(found) if hardware not in known]


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
    """One search, which continues from the results in its folder."""

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
        self._plans = SweepStore[SizedPlan](folder / "plans.jsonl", digest, asdict, plan_of)
        self._digest = digest

    @property
    def seconds(self) -> float:
        """Time that the plans took over all runs, s."""
        return self._plans.seconds

    def points(self, search: SizingSearch) -> list[SizedPoint]:
        """Return the points found, by price; fewer after a request to stop."""
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
        store = SweepStore[SizedSwing](file, self._digest, asdict, swing_of)
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
    return hashlib.sha256(f"{code_digest('bench.design.sizing.study')} {text}".encode()).hexdigest()[:16]


def draw_front(points: Sequence[SizedPoint], speed: float, path: Path) -> None:
    """Draw all planned points with the front, and the swings at the demanded `speed` (m/s), into `path`."""
    planned = [point for point in points if not point.plan.failure]
    front = non_dominated(planned)
    swung = [point for point in points if point.swing is not None and not point.swing.failure]
    with mpl.rc_context(STYLE):
        figure = styled(3.6)
        axes = figure.subplots()
        axes.scatter(
            [p.price for p in planned], [p.plan.speed for p in planned], s=14, color=GREY, label="candidates"
        )
        axes.step(
            [p.price for p in front],
            [p.plan.speed for p in front],
            where="post",
            color=COLOURS[0],
            label="front of plans by collocation alone",
        )
        axes.axhline(speed, color=COLOURS[1], linewidth=0.8, label=f"demanded, {speed:g} m/s")
        if swung:
            axes.scatter(
                [p.price for p in swung],
                [p.swing.speed for p in swung if p.swing is not None],
                s=36,
                marker="D",
                color=COLOURS[2],
                label="whole swing in closed loop",
            )
        for point in front:
            axes.annotate(
                f"{point.hardware.vane} {point.hardware.arm} {point.hardware.shoulder_valve}\n"
                f"{point.hardware.pressure / 1e5:g} bar",
                (point.price, point.plan.speed),
                xytext=(4, -12),
                textcoords="offset points",
                fontsize=6,
            )
        axes.set_xlabel("price, upper ends of the parts' classes (assumed), EUR")
        axes.set_ylabel("head speed at the ball, m/s")
        axes.legend(loc="lower right")
        save_picture(figure, path)
