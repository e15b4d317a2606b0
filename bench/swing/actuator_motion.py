"""A profile's motion in the coordinates of the actuators, and the head's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bench.base.lifecycle import Phase
from bench.swing.profile import PHASES, Profile
from sim.kinematics import right_arm_length
from sim.plant import PlantParameters
from sim.robot import RobotParameters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """The planned motion on a machine: theta1 (rad), rod extension (m), theta3 (rad); arrays (n, 3)."""

    profile: Profile
    plant: PlantParameters

    @cached_property
    def arm_lever(self) -> Array:
        """Rod extension per theta2 (n,), m/rad."""
        robot, theta2 = self.plant.robot, self.profile.angle[:, 1]
        return np.asarray(-robot.l62 * robot.l23 * np.sin(theta2) / right_arm_length(robot, theta2))

    @cached_property
    def position(self) -> Array:
        """Positions of the joint coordinates: rad, m, rad."""
        angle, robot = self.profile.angle, self.plant.robot
        return np.column_stack([angle[:, 0], right_arm_length(robot, angle[:, 1]) - robot.l56, angle[:, 2]])

    @cached_property
    def speed(self) -> Array:
        """Speeds of the joint coordinates: rad/s, m/s, rad/s."""
        velocity = self.profile.velocity
        return np.column_stack([velocity[:, 0], self.arm_lever * velocity[:, 1], velocity[:, 2]])

    @cached_property
    def head_speed(self) -> Array:
        """Speed of the face's centre (n,), m/s."""
        return head_speed(self.plant.robot, self.profile.angle, self.profile.velocity)


def head_speed(robot: RobotParameters, angle: Array, velocity: Array) -> Array:
    """Return the speed (n,; m/s) of the face's centre at `angle` (n, 3; rad) and `velocity` (n, 3; rad/s)."""
    a, w = np.cumsum(angle, axis=1), np.cumsum(velocity, axis=1)
    lengths = np.array([robot.l12, robot.l23, robot.club.length_to_face])
    x, y = (-lengths * np.sin(a) * w).sum(axis=1), (lengths * np.cos(a) * w).sum(axis=1)
    return np.asarray(np.hypot(x, y))


def phase_times(profile: Profile) -> list[tuple[Phase, float, float]]:
    """Return each phase of `profile` with its start and end (s)."""
    ends = [*profile.begins[1:], len(profile.angle)]
    return [
        (phase, begin * profile.period, end * profile.period)
        for phase, begin, end in zip(PHASES, profile.begins, ends, strict=True)
    ]
