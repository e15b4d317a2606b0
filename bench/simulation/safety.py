"""The one judge of simulated runs: which ends are unsafe, by which limits.

All limits apply to the plant's true state, not to the bench's estimates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from bench.simulation.loads import Loads


@dataclass(frozen=True)
class SafetyLimits:
    """Limits beyond which a run is unsafe."""

    load_share: float = 1.0
    """Share of a cushion's rated energy and of a chamber's rated pressure."""
    ground_touch: float = 0.005
    """Depth to which the turf may be pressed, m: a club that sinks to the ground while the air leaves touches
    it at up to about 2 m/s, which the ground's stiffness turns into this depth. A site's divot adds to it."""
    min_frame_distance: float = 0.0
    """Min distance of the club from the shoulder axis, m."""
    head_share: float = 1.05
    """Share of the profile's head speed."""
    creep: float = 0.02
    """Movement of a joint after its chambers were reported empty, rad."""
    access_pressure: float = float("inf")
    """Max pressure in manifold and chambers while people may be inside, Pa absolute."""


class RunEnd(NamedTuple):
    """The end of a run, as far as it was observed; None is not judged."""

    loads: Loads
    rested: bool | None = None
    """Whether all joints came to rest."""
    frame_distance: float | None = None
    """Smallest distance of the club from the shoulder axis, m."""
    head_share: float | None = None
    """Fastest head, as a share of the profile's."""
    creep: float | None = None
    """Movement of a joint after its chambers were reported empty, rad."""
    access_pressure: float | None = None
    """Max pressure in manifold and chambers while people may be inside, Pa absolute."""
    access_motion: float = 0.0
    """Movement of a joint while people may be inside, rad; judged as creep."""
    armed_again: bool = False
    """Whether the robot armed after a fault without a reset."""


def unsafe_reasons(end: RunEnd, limits: SafetyLimits) -> list[str]:
    """Return why `end` is unsafe, the worst load first; empty when it is safe. NaN is unsafe."""
    loads, found = end.loads, []
    if not loads.stop_share <= limits.load_share:
        found.append(f"{loads.stop} took {100 * loads.stop_share:.0f} % of its rated energy")
    if not loads.pressure_share <= limits.load_share:
        found.append(f"a chamber reached {100 * loads.pressure_share:.0f} % of its rating")
    if not loads.lowest_clearance >= -(limits.ground_touch + loads.divot):
        found.append(f"the head went {-1e3 * loads.lowest_clearance:.0f} mm into the ground")
    if end.frame_distance is not None and not end.frame_distance >= limits.min_frame_distance:
        found.append(f"the club came within {1e3 * end.frame_distance:.0f} mm of the shoulder axis")
    if end.head_share is not None and not end.head_share <= limits.head_share:
        found.append(f"the head reached {100 * end.head_share:.0f} % of the profile's speed")
    if end.creep is not None and not end.creep <= limits.creep:
        found.append(f"moved by {end.creep:.2f} rad after the chambers were reported empty")
    if end.rested is False:
        found.append("did not come to rest")
    if end.access_pressure is not None and not end.access_pressure <= limits.access_pressure:
        found.append(f"the guard was released with {1e-5 * end.access_pressure:.1f} bar inside")
    if not end.access_motion <= limits.creep:
        found.append(f"moved by {end.access_motion:.2f} rad while the guard was released")
    if end.armed_again:
        found.append("armed again without a reset")
    return found
