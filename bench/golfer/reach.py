"""How far a motion goes beyond the ranges of a machine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.kinematics import right_arm_length
from sim.plant import PlantParameters


def beyond_ranges(plant: PlantParameters, angle: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the excess of `angle` (n, 3; rad) beyond shoulder (rad), right arm (m) and wrist (rad).

    A joint that was not measured (NaN) has excess NaN.
    """
    extension = right_arm_length(plant.robot, angle[:, 1]) - plant.robot.l56
    places = (angle[:, 0], extension, angle[:, 2])
    shoulder, arm, wrist = (
        float(np.max([actuator.lower - np.min(place), np.max(place) - actuator.upper, 0.0]))
        for actuator, place in zip(plant.actuators, places, strict=True)
    )
    return shoulder, arm, wrist
