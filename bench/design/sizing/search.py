"""The search for hardware: plans and swings of candidates, from a coarse grid to single cheaper parts.

A coarse grid, single parts made cheaper around the cheapest that will do, then swings: plan, swing at the
demanded speed, faults.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from math import nan, radians
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bench.base.errors import BenchError, Refused
from bench.config import Configuration, load_configuration
from bench.design.designer import DesignFailed, design_swing, fastest_plan
from bench.design.optimal_control import BAR, SwingDemand, load_casadi
from bench.design.sizing.catalogue import (
    KINDS,
    Catalogue,
    Hardware,
    configuration_text,
    highest_pressure,
    overrides,
    parts_of,
)
from bench.design.stop_verification import SwingCheck
from bench.simulation.simulated_bench import Bench, Series
from bench.simulation.sweep import Engine, SweepStore, code_digest, sweep
from bench.swing.profile import Profile, save_profile


@dataclass(frozen=True)
class SizedPlan:
    """The fastest downswing by collocation alone."""

    speed: float
    """Head speed at the ball, m/s; nan without a plan."""
    failure: str
    """Reason for the missing plan; empty with a plan."""
    carried: tuple[float, float] = (0.0, 0.0)
    """Energies in the upper absorbers of right arm and wrist if the ball is missed (J)."""
    peak_pressure: float = 0.0
    """Max chamber pressure, Pa absolute."""
    binding: tuple[tuple[str, float], ...] = ()
    """Limits that bind: m/s of head speed for one per cent more."""


@dataclass(frozen=True)
class SizedSwing:
    """The complete swing at the required speed, simulated in closed loop on the plant."""

    speed: float
    """Head speed (m/s); nan without a swing."""
    failure: str
    """Reason for the missing swing; empty with a swing."""
    attack: float = 0.0
    """Attack angle (rad)."""
    air: float = 0.0
    """Air taken from the feed from the start of the swing to the end of its profile, kg."""
    peak_pressure: float = 0.0
    """Peak pressure (Pa absolute)."""
    struck: float = 0.0
    """Max absorber energy as a fraction of the rating, ball struck."""
    missed: float = 0.0
    """The same, ball missed."""
    silent: float = 0.0
    """The same, loss of communication at five times before the ball."""
    cases: int = 0
    """Tried fault cases of `profile check`; 0: none was tried."""
    unsafe: int = 0
    """Unsafe cases of the stopping table, loss of communication or a missing ball."""
    stuck_unsafe: int = 0
    """Unsafe cases of stuck valves."""


@dataclass(frozen=True)
class SizedPoint:
    """A hardware with its price and results."""

    hardware: Hardware
    price: int
    """Upper ends of the parts' price classes, EUR."""
    plan: SizedPlan
    swing: SizedSwing | None = None


def draw_front(points: Sequence[SizedPoint], speed: float, path: Path) -> None:
    """Draw all planned points with the front, and the swings at the demanded `speed` (m/s), into `path`."""
    import matplotlib as mpl
    import numpy as np

    from bench.records.shot.plot_style import COLOURS, GREY, STYLE, save_picture, styled

    planned = [point for point in points if not point.plan.failure]
    front = non_dominated(planned)
    swings = [(p.price, p.swing.speed) for p in points if p.swing is not None and not p.swing.failure]
    figures = ([(p.price, p.plan.speed) for p in some] for some in (planned, front))
    plans, best, swung = (np.reshape(some, (-1, 2)).T for some in (*figures, swings))
    with mpl.rc_context(STYLE):
        figure = styled(3.6)
        axes = figure.subplots()
        axes.scatter(plans[0], plans[1], s=14, color=GREY, label="candidates")
        label = "front of plans by collocation alone"
        axes.step(*best, where="post", color=COLOURS[0], label=label)
        axes.axhline(speed, color=COLOURS[1], linewidth=0.8, label=f"demanded, {speed:g} m/s")
        if swings:
            label = "whole swing in closed loop"
            axes.scatter(swung[0], swung[1], s=36, marker="D", color=COLOURS[2], label=label)
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


def non_dominated(points: Sequence[SizedPoint]) -> list[SizedPoint]:
    """Return the points with a plan that none beats in both plan speed and price, cheapest first."""
    ranked = sorted((p for p in points if not p.plan.failure), key=lambda p: (p.price, -p.plan.speed))
    front: list[SizedPoint] = []
    for point in ranked:
        if not front or point.plan.speed > front[-1].plan.speed:
            front.append(point)
    return front


def plan_of(record: dict[str, Any]) -> SizedPlan:
    """Return the plan that `asdict` made a record of."""
    binding = tuple((str(name), float(gain)) for name, gain in record["binding"])
    return SizedPlan(**record | {"carried": tuple(record["carried"]), "binding": binding})


@dataclass(frozen=True)
class SizingDemand:
    """Target of the sizing."""

    speed: float = 58.1
    """Head speed at the ball, m/s: 130 mph."""
    attack: float = 0.0
    """Attack angle, rad, up positive."""
    club: str = "driver"
    """Club of the shipped configuration."""
    reserve: float = 0.05
    """Fraction by which the fastest plan must exceed the speed before a swing is designed."""

    def of(self, hardware: Hardware, speed: float | None) -> SwingDemand:
        """Return the demand on the designer at `speed` (m/s; None: as fast as possible)."""
        return SwingDemand(head_speed=speed, attack=self.attack, pressure=highest_pressure(hardware.pressure))


def candidate_text(
    catalogue: Catalogue, hardware: Hardware, shipped: Configuration, demand: SizingDemand
) -> str:
    """Return the configuration file of `hardware`."""
    tables = overrides(catalogue, hardware, shipped.plant, demand.speed)
    heading = (
        f"Sized for {demand.speed:g} m/s at the ball. "
        f"Parts of bench/design/sizing/catalogue.toml:\n{hardware.name}"
    )
    return configuration_text({"swing": {"club": demand.club}} | tables, heading)


def candidate_configuration(text: str) -> Configuration:
    """Return the configuration that a file with `text` makes, read as any other.

    Raises:
        ExceptionGroup: BenchErrors, if the hardware makes no valid configuration.
    """
    with TemporaryDirectory() as folder:
        file = Path(folder) / "candidate.toml"
        file.write_text(text, encoding="utf-8")
        return load_configuration(file)


def _reasons(group: ExceptionGroup[Exception]) -> str:
    found = (fault for fault in group.exceptions if isinstance(fault, BenchError))
    return "; ".join(f"found {one.found}, expected {one.expected}. {one.action}" for one in found)


@dataclass(frozen=True)
class PlanStudy:
    """The fastest plan of each hardware, by collocation alone."""

    catalogue: Catalogue
    demand: SizingDemand

    def prepared(self) -> Callable[[Hardware], SizedPlan]:
        """Return the search for a plan. Raises BenchError without the package casadi."""
        load_casadi()
        shipped = load_configuration(Path("shipped"))
        return lambda hardware: self._planned(hardware, shipped)

    def _planned(self, hardware: Hardware, shipped: Configuration) -> SizedPlan:
        try:
            c = candidate_configuration(candidate_text(self.catalogue, hardware, shipped, self.demand))
            plan = fastest_plan(c, self.demand.of(hardware, None))
        except ExceptionGroup as group:
            return SizedPlan(nan, f"no valid configuration: {_reasons(group)}")
        except DesignFailed as failure:
            return SizedPlan(nan, str(failure))
        if not plan.solved:
            return SizedPlan(nan, f"no plan ({plan.status.lower().replace('_', ' ')})")
        binding = tuple((name, float(gain)) for name, gain in list(plan.binding.items())[:4])
        arm, wrist = plan.carried.tolist()
        return SizedPlan(plan.speed, "", (arm, wrist), BAR * float(plan.state[:, 6:12].max()), binding)


@dataclass(frozen=True)
class SwingStudy:
    """The whole swing of each hardware at the demanded speed, and its faults if requested."""

    catalogue: Catalogue
    demand: SizingDemand
    spacing: int
    """Ticks between the instants at which faults are tried; 0: no faults."""
    folder: Path
    """Folder for configurations and profiles of the candidates that swing."""

    def prepared(self) -> Callable[[Hardware], SizedSwing]:
        """Return the design of a swing. Raises BenchError without the package casadi."""
        load_casadi()
        shipped = load_configuration(Path("shipped"))
        return lambda hardware: self._swung(hardware, shipped)

    def _swung(self, hardware: Hardware, shipped: Configuration) -> SizedSwing:
        c = candidate_configuration(candidate_text(self.catalogue, hardware, shipped, self.demand))
        c = replace(c, envelope=c.envelope.with_model_check("off"))  # a new plant has no limits for it yet
        try:
            made = design_swing(c, self.demand.of(hardware, self.demand.speed), "sized")
            found = _judged(c, made, self.spacing)
        except (DesignFailed, Refused) as failure:
            return SizedSwing(nan, str(failure))
        save_profile(self.folder / f"{hardware.name}.profile.toml", made)
        return found


def _judged(c: Configuration, profile: Profile, spacing: int) -> SizedSwing:
    """Return the figures of a swing; with `spacing` also how stops and faults end.

    Raises:
        Refused: the swing does not run.
    """
    bench = Bench.of(c, profile)
    swing = Series(bench, c.plant).swing(profile)
    limits, delivery = profile.limits, profile.delivery
    found = SizedSwing(
        delivery["head_speed_mps"],
        "",
        radians(delivery["attack_angle_deg"]),
        swing.air_used,
        limits["peak_pressure_pa"],
        limits["stop_share"],
        limits["stop_share_missed"],
        limits["stop_share_silent"],
    )
    if not spacing:
        return found
    outcomes = SwingCheck(bench).outcomes(spacing=spacing)
    unsafe = [outcome.fault for outcome in outcomes if outcome.unsafe]
    stuck = sum("stuck" in fault for fault in unsafe)
    return replace(found, cases=len(outcomes), unsafe=len(unsafe) - stuck, stuck_unsafe=stuck)


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
        free = product(self.pressures, self.levers, self.lever_angles, self.frames, self.hoses, self.vents)
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
        self._digest = _digest(catalogue, demand)
        self._plans = SweepStore[SizedPlan](folder / "plans.jsonl", self._digest, asdict, plan_of)

    @property
    def seconds(self) -> float:
        """Time that the plans took over all runs, s."""
        return self._plans.seconds

    def points(self, search: SizingSearch) -> list[SizedPoint]:
        """Return the points found, by price; fewer after a request to stop."""
        tried = search.grid.candidates(self.catalogue)
        points = self._planned("plans of the grid", tried)
        for count in range(search.rounds):
            best = min(self.enough(points), key=lambda one: (one.price, -one.plan.speed), default=None)
            if best is None or self._stop():
                break
            new = [hardware for hardware in cheaper(self.catalogue, best.hardware) if hardware not in tried]
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

    def enough(self, points: Sequence[SizedPoint]) -> list[SizedPoint]:
        """Return the points whose plan exceeds the demanded speed by the reserve."""
        least = self.demand.speed * (1.0 + self.demand.reserve)
        return [point for point in points if point.plan.speed >= least]

    def _swung(self, points: list[SizedPoint], search: SizingSearch) -> list[SizedPoint]:
        chosen = [point.hardware for point in non_dominated(self.enough(points))[: search.swings]]
        if not chosen or self._stop():
            return points
        file = self.folder / f"swings-{search.spacing}.jsonl"
        store = SweepStore[SizedSwing](file, self._digest, asdict, lambda record: SizedSwing(**record))
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
    return hashlib.sha256(f"{code_digest('bench.design.sizing.search')} {text}".encode()).hexdigest()[:16]
