"""End stops as homing finds them: the angles of joints pressed there, and the head's error for a wrong zero.

A joint pressed against its stop rests where the stop's spring balances chamber pressure and gravity. The
pressure is below supply pressure: the valve is only slightly open, and chambers leak.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from bench.swing.profile import Profile
from sim.driver import joint_travel
from sim.kane import inverse_dynamics
from sim.kinematics import forward_kinematics, right_arm_length, theta2_from_right_arm
from sim.plant import PlantParameters

Array: TypeAlias = np.ndarray[Any, Any]

_PRESSED = 0.83
"""Fraction of the depth at full supply pressure to which homing presses a joint: 0.77 to 0.95 on simulated
plants, which is within 0.7 mrad."""
_MIN_SHARE = 0.4
"""Fraction of the head's tolerance that is left to the zeros where stops are soft."""
_STEP = 1e-5
"""Step of joint angles in derivatives (rad)."""


def pressed_stops(plant: PlantParameters, direction: Sequence[int]) -> Array:
    """Return the angles (3,) rad at which joints rest, pressed against their stops in `direction` (±1)."""
    return _pressed(plant, direction, _PRESSED)


def stop_tolerance(
    plant: PlantParameters, profile: Profile, direction: Sequence[int], head_tolerance: float
) -> Array:
    """Return the max deviation (3,) rad of joints from their pressed stops.

    No zero that passes shifts the head at the ball by more than `head_tolerance` (m), however deep the air
    has pressed the joint; where stops are so soft that _MIN_SHARE holds, by that depth more.
    """
    whole = head_tolerance / head_travel(plant, profile)
    deeper = np.abs(_pressed(plant, direction, 1.0) - pressed_stops(plant, direction))
    return np.asarray(np.maximum(whole - deeper, _MIN_SHARE * whole))


def _pressed(plant: PlantParameters, direction: Sequence[int], share: float) -> Array:
    """Return the angles (3,) rad of joints at `share` of their depth at full supply pressure."""
    lower, upper = joint_travel(plant)
    towards = np.array(direction)
    ends = np.where(towards < 0, lower, upper)
    load = inverse_dynamics(plant.robot, ends, np.zeros(3), np.zeros(3))
    pressure = plant.supply.pressure - plant.supply.atmosphere
    lever = np.array([1.0, 1.0, plant.wrist_lever * float(plant.wrist_authority(ends[2]))])
    area = [a.area_b if way < 0 else a.area_a for a, way in zip(plant.actuators, direction, strict=True)]
    stiffness = np.array([actuator.stop.stiffness for actuator in plant.actuators])
    depth = share * np.maximum(pressure * np.array(area) * lever - towards * load, 0.0) / stiffness
    length = float(right_arm_length(plant.robot, ends[1])) + towards[1] * depth[1]
    pressed = ends + towards * depth
    pressed[1] = float(theta2_from_right_arm(plant.robot, length))
    return np.asarray(pressed)


def head_travel(plant: PlantParameters, profile: Profile) -> Array:
    """Return by how much a wrong encoder zero of each joint (3,) shifts the head at the ball (m/rad)."""
    at = profile.angle_at_impact
    moved = [
        forward_kinematics(plant.robot, at + step) - forward_kinematics(plant.robot, at - step)
        for step in _STEP * np.eye(3)
    ]
    return np.asarray(np.hypot(*np.array(moved).T[:2])) / (2 * _STEP)
