"""The work on one candidate, for sweeps, and its results: plan, swing at the demanded speed, faults."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import nan, radians
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bench.base.errors import BenchError, Refused
from bench.config import Configuration, load_configuration
from bench.design.designer import DesignFailed, design_swing, fastest_plan
from bench.design.optimal_control import BAR, DownswingPlan, SwingDemand, load_casadi
from bench.design.sizing.catalogue import Catalogue
from bench.design.sizing.hardware import Hardware, configuration_text, highest_pressure, overrides
from bench.design.stop_verification import SwingCheck
from bench.simulation.series import Bench, Series
from bench.swing.profile import Profile, save_profile


@dataclass(frozen=True)
class SizedPlan:
    """The fastest downswing by collocation alone."""

    speed: float
    """Head speed at the ball, m/s; nan without a plan."""
    failure: str
    """Why there is no plan; empty if there is one."""
    carried: tuple[float, float] = (0.0, 0.0)
    """Energies brought to the upper cushions of right arm and wrist if the ball is missed, J."""
    peak_pressure: float = 0.0
    """Max chamber pressure, Pa absolute."""
    binding: tuple[tuple[str, float], ...] = ()
    """Limits that bind: m/s of head speed for one per cent more."""


@dataclass(frozen=True)
class SizedSwing:
    """The whole swing at the demanded speed in closed loop, on the plant."""

    speed: float
    """Head speed (m/s); nan without a swing."""
    failure: str
    """Why there is no swing; empty if there is one."""
    attack: float = 0.0
    """Attack angle (rad)."""
    air: float = 0.0
    """Air taken from the feed from the start of the swing to the end of its profile, kg."""
    peak_pressure: float = 0.0
    """Peak pressure (Pa absolute)."""
    struck: float = 0.0
    """Worst cushion energy as a share of its rating, ball struck."""
    missed: float = 0.0
    """The same, ball missed."""
    silent: float = 0.0
    """The same, bench silent at five times before the ball."""
    cases: int = 0
    """Tried fault cases of `profile check`; 0: none was tried."""
    unsafe: int = 0
    """Unsafe cases of the stopping table, a silent bench or a missing ball."""
    stuck_unsafe: int = 0
    """Unsafe cases of stuck valves."""


@dataclass(frozen=True)
class SizedPoint:
    """A hardware with its price and results."""

    hardware: Hardware
    price: int
    """Upper ends of the parts' price classes, EUR."""
    plan: SizedPlan
    swing: SizedSwing | None = field(default=None)


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


def swing_of(record: dict[str, Any]) -> SizedSwing:
    """Return the swing that `asdict` made a record of."""
    return SizedSwing(**record)


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
    """Share by which the fastest plan must exceed the speed before a swing is designed."""

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
        """Return the search for a plan.

        Raises:
            BenchError: the package casadi is not installed.
        """
        load_casadi()
        shipped = load_configuration(Path("shipped"))
        return lambda hardware: self._planned(hardware, shipped)

    def _planned(self, hardware: Hardware, shipped: Configuration) -> SizedPlan:
        text = candidate_text(self.catalogue, hardware, shipped, self.demand)
        try:
            c = candidate_configuration(text)
            wanted = self.demand.of(hardware, None)
            plan = fastest_plan(c, wanted)
        except ExceptionGroup as group:
            return SizedPlan(nan, f"no valid configuration: {_reasons(group)}")
        except DesignFailed as failure:
            return SizedPlan(nan, str(failure))
        return _as_sized(plan)


def _as_sized(plan: DownswingPlan) -> SizedPlan:
    if not plan.solved:
        return SizedPlan(nan, f"no plan ({plan.status.lower().replace('_', ' ')})")
    return SizedPlan(
        plan.speed,
        "",
        (float(plan.carried[0]), float(plan.carried[1])),
        BAR * float(plan.state[:, 6:12].max()),
        tuple((name, float(gain)) for name, gain in list(plan.binding.items())[:4]),
    )


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
        """Return the design of a swing.

        Raises:
            BenchError: the package casadi is not installed.
        """
        load_casadi()
        shipped = load_configuration(Path("shipped"))
        return lambda hardware: self._swung(hardware, shipped)

    def _swung(self, hardware: Hardware, shipped: Configuration) -> SizedSwing:
        text = candidate_text(self.catalogue, hardware, shipped, self.demand)
        c = candidate_configuration(text)
        c = replace(c, envelope=c.envelope.with_model_check("off"))  # a new plant has no limits for it yet
        try:
            wanted = self.demand.of(hardware, self.demand.speed)
            made = design_swing(c, wanted, "sized")
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
    series = Series(Bench.of(c, profile), c.plant)
    swing = series.swing(profile)
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
    check = SwingCheck(c.plant, profile, c.control, c.envelope, c.estimator)
    outcomes = check.outcomes(spacing=spacing)
    unsafe = [outcome.fault for outcome in outcomes if outcome.unsafe]
    stuck = sum("stuck" in fault for fault in unsafe)
    return replace(found, cases=len(outcomes), unsafe=len(unsafe) - stuck, stuck_unsafe=stuck)
