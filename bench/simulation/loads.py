"""Loads on a simulated robot: extremes since a tally began, and their shares of the ratings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
    """Return cushion energies (..., 3, 2) J as shares of the ratings; 1 is the limit."""
    return np.asarray(energy / np.array([[actuator.stop.rating] for actuator in plant.actuators]))


def pressure_shares(pressure: Array, plant: PlantParameters) -> Array:
    """Return chamber pressures (6,) Pa absolute as shares (3, 2) of the ratings; 1 is the limit."""
    ratings = np.array([[actuator.pressure_rating] for actuator in plant.actuators])
    return np.asarray(pressure.reshape(3, 2) / ratings)


@dataclass(frozen=True, eq=False)
class Loads:
    """Extremes of a run since `reset_peaks`; shares are of the ratings, 1 is the limit."""

    stop_energy: Array
    """Max energy taken by each cushion, (3, 2) J: lower and upper end of shoulder, right arm, wrist."""
    peak_pressure: Array
    """(6,) Pa absolute in the order of drivers.base.CHAMBERS."""
    lowest_clearance: float
    """Sole over ground, m."""
    peak_head_speed: float
    """Peak head speed (m/s)."""
    stop_share: float
    """Energy of the most loaded cushion."""
    stop: str
    """Name of the most loaded cushion."""
    depth_share: float
    """Share of a cushion's travel that was pressed in."""
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
