"""The forces that a profile demands of its actuators: Kane's inverse dynamics of the reference, beforehand.

Positions are tables, so velocities and accelerations are their slopes, smoothed by parabolas over some
samples; not across the instants at which a reference may jump: where the downswing takes over from the top,
and where the impact window begins. From there on, as the impact's forces are not the actuators', the last
force is held.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.law.feed_forward import FeedForward
from bench.swing.profile import Profile
from sim.kane import inverse_dynamics
from sim.kinematics import right_arm_length
from sim.plant import PlantParameters

Array = NDArray[np.float64]

_SPAN = 0.014
"""Time over which a slope is smoothed (s)."""
_TURNING = 0.05
"""Speed over which friction changes sides (rad/s)."""


class ForceDemand(NamedTuple):
    """Forces of the three actuators at the profile's samples, (n, 3), and their rates."""

    force: Array
    """N, of the shoulder N m: positive from chamber A; the wrist's along its cylinder."""
    rate: Array
    """N/s, N m/s"""


def demand_for(feed_forward: FeedForward, plant: PlantParameters, profile: Profile) -> ForceDemand:
    """Return the forces for a controller with `feed_forward`: `demand_of`, or zeros if it uses none."""
    if feed_forward == "kane+pneumatic":
        return demand_of(plant, profile)
    return ForceDemand(np.zeros(profile.angle.shape), np.zeros(profile.angle.shape))


def demand_of(plant: PlantParameters, profile: Profile) -> ForceDemand:
    """Return the actuator forces that `profile` requires of `plant`, friction included.

    The tables lead by the lag of each spool and half a tick.
    """
    period, n = profile.period, len(profile.angle)
    force, rate = np.zeros((n, 3)), np.zeros((n, 3))
    window = profile.begins[5]
    for first, last in ((0, profile.begins[3]), (profile.begins[3], window)):
        if last <= first:
            continue
        rows = slice(first, last)
        angle = profile.angle[rows]
        velocity, acceleration = _slope(angle, period, 1), _slope(angle, period, 2)
        force[rows] = actuator_forces(plant, angle, velocity, acceleration)
        rate[rows] = _slope(force[rows], period, 1)
    force[window:] = force[max(window - 1, 0)]
    return ForceDemand(*(_earlier(table, plant, profile) for table in (force, rate)))


def actuator_forces(plant: PlantParameters, angle: Array, velocity: Array, acceleration: Array) -> Array:
    """Return the actuators' forces (n, 3) (N, shoulder N m) that move the robot so; joints (n, 3)."""
    robot = plant.robot
    force = inverse_dynamics(robot, angle, velocity, acceleration)
    lever = plant.wrist_slope(angle[:, 2])
    force[:, 2] /= lever
    arm = right_arm_length(robot, angle[:, 1])
    slope = -robot.l62 * robot.l23 * np.sin(angle[:, 1]) / arm
    speed = np.column_stack([velocity[:, 0], slope * velocity[:, 1], lever * velocity[:, 2]])
    frictions = [actuator.friction for actuator in plant.actuators]
    viscous, coulomb = (np.array([getattr(f, name) for f in frictions]) for name in ("viscous", "coulomb"))
    # Levers are positive in the working range: joint and actuator move the same way.
    return np.asarray(force + viscous * speed + coulomb * np.tanh(velocity / _TURNING))


def _slope(table: Array, period: float, order: int) -> Array:
    """Return the derivative of `order` 0, 1 or 2 of `table` (n, 3) by s."""
    from scipy.signal import savgol_filter  # here, for it takes long to import and few controllers need it

    samples = min(2 * round(_SPAN / period / 2) + 1, len(table) - 1 + len(table) % 2)
    if samples < 3:
        return np.zeros_like(table)
    return np.asarray(
        savgol_filter(table, samples, 2, deriv=order, delta=period, axis=0, mode="interp"), dtype=float
    )


def _earlier(table: Array, plant: PlantParameters, profile: Profile) -> Array:
    """Return `table` (n, 3) read ahead by the lag of each actuator's spool and half a tick."""
    at = np.arange(len(table)) * profile.period
    lag = [2 * a.valve.damping_ratio / a.valve.natural_frequency + plant.tick / 2 for a in plant.actuators]
    return np.column_stack([np.interp(at + lag[i], at, table[:, i]) for i in range(3)])
