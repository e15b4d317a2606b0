"""Limits of the air along a given motion, before anything moves (golf.md 8; ISO 6358).

A strict bound: with the motion given, a chamber that takes all the air of its fully open valve and loses none
has the max pressure that any command could give; one that only loses air has the min pressure. A motion that
needs more force than these pressures give is beyond valves and supply. One that passes may still be hard to
follow.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.control.moves.pressure_plan import falling_root
from bench.swing.motion import Motion
from drivers.base.compiled import compiled
from sim.kane import inverse_dynamics
from sim.pneumatics import FLOW_TO_PRESSURE, Actuator, Supply, flow, stop_force

Array = NDArray[np.float64]

_SUBSTEPS = 4


def needed_force(motion: Motion) -> Array:
    """Return the actuator forces (n - 1, 3) that the motion needs between samples: N m, N, N.

    Inverse dynamics of the robot, with viscous and dry friction, minus the forces of the end stops.
    """
    plant, profile = motion.plant, motion.profile
    angle, velocity = _middle(profile.angle), _middle(profile.velocity)
    acceleration = np.diff(profile.velocity, axis=0) / profile.period
    effort = np.asarray(inverse_dynamics(plant.robot, angle, velocity, acceleration))
    position, speed = _middle(motion.position), _middle(motion.speed)
    wrist_lever = plant.wrist_slope(angle[:, 2])
    force = np.empty_like(effort)
    for i, actuator in enumerate(plant.actuators):
        own = effort[:, i] - stop_forces(actuator, position[:, i], speed[:, i])
        stroke_speed = speed[:, i]
        if i == 2:
            own, stroke_speed = own / wrist_lever, wrist_lever * stroke_speed
        friction = actuator.friction
        dry = friction.coulomb * np.tanh(stroke_speed / friction.stribeck_speed)
        force[:, i] = own + friction.viscous * stroke_speed + dry
    return force


def _middle(values: Array) -> Array:
    return (values[1:] + values[:-1]) / 2


def stop_forces(actuator: Actuator, position: Array, speed: Array) -> Array:
    """Return the force (n,) of the end stops on the joint coordinate, positive upwards: N m, N, N m."""
    stop, force = actuator.stop, np.zeros(len(position))
    for sign, end in ((-1.0, actuator.upper), (1.0, actuator.lower)):
        depth = sign * (end - position)
        for k in np.flatnonzero(depth > 0):
            force[k] = sign * stop_force(
                stop.stiffness, stop.travel, stop.damping_speed, depth[k], -sign * speed[k]
            )
    return force


def force_bounds(motion: Motion) -> Array:
    """Return the min and max force (n, 3, 2) that any command can give along the motion: N m, N, N."""
    plant = motion.plant
    atmosphere = plant.supply.atmosphere
    bounds = np.empty((len(motion.position), 3, 2))
    for i, actuator in enumerate(plant.actuators):
        stroke, ends = motion.position[:, i], np.array(actuator.chamber_ends)
        if i == 2:
            stroke, ends = plant.wrist_stroke(stroke), plant.wrist_stroke(ends)
        volume_a = actuator.dead_volume + actuator.area_a * (stroke - ends[0])
        volume_b = actuator.dead_volume + actuator.area_b * (ends[1] - stroke)
        low_a, high_a = _extreme_pressures(volume_a, motion.profile.period, actuator, plant.supply)
        low_b, high_b = _extreme_pressures(volume_b, motion.profile.period, actuator, plant.supply)
        for side, (a, b) in enumerate(((low_a, high_b), (high_a, low_b))):
            bounds[:, i, side] = (a - atmosphere) * actuator.area_a - (b - atmosphere) * actuator.area_b
    return bounds


def _extreme_pressures(
    volume: Array, period: float, actuator: Actuator, supply: Supply
) -> tuple[Array, Array]:
    """Return the lowest and highest pressure (n,) Pa a chamber of `volume` (n,) m3 can have."""
    low, high = np.full(len(volume), supply.atmosphere), np.full(len(volume), supply.pressure)
    _fill_and_empty(
        np.maximum(volume, 0.2 * actuator.dead_volume),
        period,
        actuator.valve.conductance + actuator.cross_leakage,
        actuator.valve.critical_ratio,
        supply.pressure,
        supply.atmosphere,
        supply.polytropic_exponent,
        low,
        high,
    )
    return low, np.minimum(high, actuator.pressure_rating)


@compiled
def _fill_and_empty(
    volume: Any,
    period: float,
    conductance: float,
    ratio: float,
    supply: float,
    atmosphere: float,
    exponent: float,
    low: Any,
    high: Any,
) -> None:
    """Write pressures of a chamber that only loses (`low`) and only takes (`high`) air, from the first on."""
    step = period / _SUBSTEPS
    for k in range(1, len(volume)):
        emptied, filled = low[k - 1], high[k - 1]
        swept = (volume[k] - volume[k - 1]) / period
        for j in range(_SUBSTEPS):
            gain = exponent * step / (volume[k - 1] + swept * step * (j + 0.5))
            # Implicit in the chamber's own pressure: stable for small chambers too.
            out = max(flow(conductance, emptied, atmosphere, ratio), 0.0)
            emptied /= 1.0 + gain * (swept + out / emptied)
            into = max(flow(conductance, supply, filled, ratio), 0.0)
            filled = (filled + gain * into) / (1.0 + gain * swept)
        low[k], high[k] = emptied, filled


def steady_speed(actuator: Actuator, supply: Supply) -> float:
    """Return the speed (m/s, vane rad/s) at which a fully open valve leaves the actuator no force.

    At rest in the actuator's frame the air that comes in is p A v, the air that leaves too. The faster
    direction counts. A swing may be faster for a short way, on air that is already in the chamber.
    """
    forwards = _steady(actuator, supply, actuator.area_a, actuator.area_b)
    return max(forwards, _steady(actuator, supply, actuator.area_b, actuator.area_a))


def _steady(actuator: Actuator, supply: Supply, driving: float, driven: float) -> float:
    c, ratio = actuator.valve.conductance, actuator.valve.critical_ratio

    def force(speed: float) -> float:
        p = falling_root(
            lambda p: flow(c, supply.pressure, p, ratio) - p * driving * speed, 1e3, supply.pressure
        )
        q = falling_root(
            lambda q: q * driven * speed - flow(c, q, supply.atmosphere, ratio), supply.atmosphere, 1e9
        )
        return (p - supply.atmosphere) * driving - (q - supply.atmosphere) * driven

    # The driven chamber cannot be emptied faster than at the speed of sound, whatever its pressure.
    sonic = c * FLOW_TO_PRESSURE / driven
    return falling_root(force, 1e-6 * sonic, sonic)
