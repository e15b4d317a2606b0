"""Results of one choice of hardware: plan, swing, faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from bench.sizing.hardware import Hardware


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
    """m/s; nan without a swing."""
    failure: str
    """Why there is no swing; empty if there is one."""
    attack: float = 0.0
    """rad"""
    air: float = 0.0
    """Air taken from the feed from the start of the swing to the end of its profile, kg."""
    peak_pressure: float = 0.0
    """Pa absolute."""
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
    """A hardware with its price and what was found."""

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


def as_json(result: SizedPlan | SizedSwing) -> dict[str, Any]:
    """Return `result` for a store."""
    return asdict(result)


def plan_of(record: dict[str, Any]) -> SizedPlan:
    """Return the plan that `as_json` made a record of."""
    binding = tuple((str(name), float(gain)) for name, gain in record["binding"])
    return SizedPlan(**record | {"carried": tuple(record["carried"]), "binding": binding})


def swing_of(record: dict[str, Any]) -> SizedSwing:
    """Return the swing that `as_json` made a record of."""
    return SizedSwing(**record)
