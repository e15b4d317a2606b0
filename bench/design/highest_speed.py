"""The highest speed that a plant can swing: downswings at rising demanded speeds, until one fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
from typing import NamedTuple

from bench.config import Configuration
from bench.design.designer import DesignFailed, plan_at_speed
from bench.design.optimal_control import DownswingPlan, SwingDemand, load_casadi
from bench.simulation.sweep import Engine, sweep
from bench.swing.profile import Profile

STEP, NEAREST = 2.0, 0.5
"""Step of the demanded speed, and max gap between the fastest found and the slowest failed one, m/s."""
TOGETHER = 2
"""Speeds tried at a time; the same number on any engine, as the result depends on it."""


class HighestSpeed(NamedTuple):
    """The fastest downswing that was found."""

    plan: DownswingPlan
    limit: str
    """Why a higher speed failed."""


@dataclass(frozen=True)
class DownswingStudy:
    """The downswing at each speed (m/s), or the fastest plan for None; a text if none was found."""

    configuration: Configuration
    demand: SwingDemand
    start: Profile | None

    def prepared(self) -> Callable[[float | None], DownswingPlan | str]:
        """Return the search at a speed. Raises BenchError without the package casadi."""
        load_casadi()
        return self._search

    def _search(self, speed: float | None) -> DownswingPlan | str:
        demand = replace(self.demand, head_speed=speed, follow=None)
        try:
            return plan_at_speed(self.configuration, demand, self.start)
        except DesignFailed as failure:
            return str(failure)


def highest_speed(
    study: DownswingStudy, engine: Engine, progress: Callable[[str], None] = lambda what: None
) -> HighestSpeed:
    """Return the fastest downswing within the demand that the plant follows within its absorber limits.

    The fastest plan is only a start, or the speed of the swing that the search starts from, if the plant does
    not follow that plan. If the absorbers must also hold with a missed ball, the required speed is
    raised until half a m/s more fails. `progress` gets the speeds that are tried.

    Raises:
        BenchError: the package casadi is not installed.
        DesignFailed: no downswing was found.
    """
    load_casadi()
    progress("as fast as it goes")
    begun = sweep(study, [None], engine)[0]
    if isinstance(begun, str):
        # The plant could not follow that plan. The swing that the search starts from is known to be possible.
        known = study.start.delivery.get("head_speed_mps") if study.start is not None else None
        if known is None:
            raise DesignFailed(begun)
        progress(f"{known:.1f} m/s")
        begun = sweep(study, [known], engine)[0]
    if isinstance(begun, str):
        raise DesignFailed(begun)
    plan, failed, limit = begun, inf, ""
    while failed - plan.speed > NEAREST:
        step = min(STEP, (failed - plan.speed) / (TOGETHER + 1))
        speeds = [plan.speed + step * (k + 1) for k in range(TOGETHER)]
        progress(" and ".join(f"{speed:.1f}" for speed in speeds) + " m/s")
        for speed, found in zip(speeds, sweep(study, speeds, engine), strict=True):
            if isinstance(found, str):
                failed, limit = speed, f"at {speed:.1f} m/s {found}"
                break
            plan = found
    return HighestSpeed(plan, limit)
