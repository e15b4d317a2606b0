"""Loads on a simulated robot, and the one judge of simulated runs: which ends are unsafe, by which limits.

Loads are extremes since a tally began, and their shares of the ratings. All limits apply to the plant's true
state, not to the bench's estimates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.base import JOINTS
from sim.plant import PlantParameters

Array = NDArray[np.float64]


def reset_peaks(plant_state: NDArray[Any]) -> None:
    """Reset the extremes in `plant_state` (PLANT_STATE records); they do not influence the motion."""
    plant_state["stop_energy"] = plant_state["stop_work"] = plant_state["stop_depth"] = 0.0
    plant_state["peak_pressure"] = plant_state["pressure"]
    plant_state["lowest_clearance"], plant_state["peak_head_speed"] = np.inf, 0.0


def stop_shares(energy: Array, plant: PlantParameters) -> Array:
    """Return absorber energies (..., 3, 2) J as fractions of the ratings; 1 is the limit."""
    return np.asarray(energy / np.array([[actuator.stop.rating] for actuator in plant.actuators]))


def pressure_shares(pressure: Array, plant: PlantParameters) -> Array:
    """Return chamber pressures (6,) Pa absolute as shares (3, 2) of the ratings; 1 is the limit."""
    ratings = np.array([[actuator.pressure_rating] for actuator in plant.actuators])
    return np.asarray(pressure.reshape(3, 2) / ratings)


@dataclass(frozen=True, eq=False)
class Loads:
    """Extremes of a run since `reset_peaks`; shares are of the ratings, 1 is the limit."""

    stop_energy: Array
    """Max energy (3, 2) in each absorber, lower and upper end of shoulder, right arm, wrist (J)."""
    peak_pressure: Array
    """(6,) Pa absolute in the order of drivers.base.CHAMBERS."""
    lowest_clearance: float
    """Sole over ground, m."""
    peak_head_speed: float
    """Peak head speed (m/s)."""
    stop_share: float
    """Energy of the most loaded absorber."""
    stop: str
    """Name of the most loaded absorber."""
    depth_share: float
    """Max compression of an absorber, as a fraction of its travel."""
    pressure_share: float
    """Pressure of the most loaded chamber."""
    divot: float = 0.0
    """Depth to which the sole may go into the surface by the ball, m."""


def loads_of(plant_state: NDArray[Any], plant: PlantParameters) -> Loads:
    """Return the loads in `plant_state` (one PLANT_STATE record) of the plant with parameters `plant`."""
    state = plant_state[0]
    energy = stop_shares(state["stop_energy"], plant)
    depth = state["stop_depth"] / np.array([[actuator.stop.travel] for actuator in plant.actuators])
    joint, side = np.unravel_index(int(np.argmax(energy)), energy.shape)
    return Loads(
        stop_energy=state["stop_energy"].copy(),
        peak_pressure=state["peak_pressure"].copy(),
        lowest_clearance=float(state["lowest_clearance"]),
        peak_head_speed=float(state["peak_head_speed"]),
        stop_share=float(energy.max()),
        stop=f"{JOINTS[int(joint)]} {('lower', 'upper')[int(side)]} stop",
        depth_share=float(depth.max()),
        pressure_share=float(pressure_shares(state["peak_pressure"], plant).max()),
        divot=plant.site.divot,
    )


@dataclass(frozen=True)
class SafetyLimits:
    """Limits beyond which a run is unsafe."""

    load_share: float = 1.0
    """Max fraction of an absorber's rated energy and of a chamber's rated pressure."""
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
