"""Chamber pressures that a profile plans for its address: the balance under load with a dithered spool.

A spool may fill one chamber for a fraction of the time and exhaust the other meanwhile. This drives each
chamber to the pressure at which its inflow and outflow are equal. One fraction gives the force that holds the
joint at the address without friction. Its pressures are planned, as the robot reaches and keeps them
automatically.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import pi

import numpy as np
from numpy.typing import NDArray

from bench.control.law.force_reference import actuator_forces
from bench.swing.profile import Profile
from drivers.base import ACTUATORS
from sim.kinematics import right_arm_length
from sim.plant import PlantParameters
from sim.pneumatics import flow

Array = NDArray[np.float64]

SETTLING = 0.5
"""Time in which the sum of two pressures comes two thirds of the way to its balance (s)."""
_PERIOD, _QUICK = 0.012, 2.0 * pi * 100.0
"""Time between two changes of side that lead the same way (s), for spools of at least this natural frequency
(rad/s)."""
_MAX_AMPLITUDE = 0.4
"""Max dither amplitude of a spool, as a valve command."""
_HARMONICS = 30
"""Limit of the harmonics of a square wave; a spool follows the first few."""
_MIN_SHARE, _MAX_SHARE = 0.02, 0.98
"""Min and max fraction of time in which a chamber is filled to hold a load."""


def with_planned_air(profile: Profile, plant: PlantParameters) -> Profile:
    """Return `profile` with the pressures that `plant` has at its address.

    Raises:
        ValueError: an actuator cannot hold its joint there.
    """
    pressures = planned_air(plant, profile.angle[0])
    return replace(profile, air=tuple(pressures.tolist()), air_supply=plant.supply.pressure)


def planned_air(plant: PlantParameters, angle: Array) -> Array:
    """Return the chamber pressures (6,) (Pa absolute) that hold `plant` at the joint angles `angle` (3,).

    Raises:
        ValueError: an actuator cannot hold its joint there.
    """
    at_rest = np.zeros((1, 3))
    load = actuator_forces(plant, angle.reshape(1, 3), at_rest, at_rest)[0]
    pressures = np.zeros(6)
    for i, actuator in enumerate(plant.actuators):
        if not _force(plant, i, _MIN_SHARE) < load[i] < _force(plant, i, _MAX_SHARE):
            raise ValueError(f"{ACTUATORS[i]}: cannot hold {load[i]:.0f} N (shoulder: N m) at the address")
        share = falling_root(partial(_shortfall, plant, i, float(load[i])), _MIN_SHARE, _MAX_SHARE)
        pressures[2 * i : 2 * i + 2] = _balance(plant, i, share), _balance(plant, i, 1.0 - share)
        if pressures[2 * i : 2 * i + 2].max() > actuator.pressure_rating:
            raise ValueError(f"{ACTUATORS[i]}: needs more than its pressure rating at the address")
    return pressures


def dither_amplitudes(plant: PlantParameters, machine: Array, angle: Array) -> Array:
    """Return the dither amplitudes (3,), as valve commands, at the address `angle` (3,) in rad.

    They follow from the chambers' volumes and the valves: each sum settles in SETTLING. `machine` is the
    plant's PLANT_PARAMETERS record.
    """
    p, widths = machine[0], np.zeros(3)
    position = (
        angle[0],
        float(right_arm_length(plant.robot, angle[1])) - plant.robot.l56,
        float(plant.wrist_stroke(angle[2])),
    )
    for i, actuator in enumerate(plant.actuators):
        valve = actuator.valve
        volume = 0.5 * (
            2.0 * p["dead_volume"][i]
            + p["area_a"][i] * (position[i] - p["volume_lower"][i])
            + p["area_b"][i] * (p["volume_upper"][i] - position[i])
        )
        at, step = _balance(plant, i, 0.5), 1e3
        slope = (_net(plant, i, 0.5, at - step) - _net(plant, i, 0.5, at + step)) / (2.0 * step)
        open_ = volume / (plant.supply.polytropic_exponent * slope * SETTLING)
        widths[i] = min(valve.dead_band + (1.0 - valve.dead_band) * open_, _MAX_AMPLITUDE)
    return widths


def dither_periods(plant: PlantParameters) -> Array:
    """Return the dither periods (3,) of the spools (s): longer where a slow one would not follow.

    They differ, as in a long period a quick spool admits so much air that the joint breaks away.
    """
    frequency = np.array([actuator.valve.natural_frequency for actuator in plant.actuators])
    return np.asarray(_PERIOD * np.maximum(_QUICK / frequency, 1.0))


def dither_duties(plant: PlantParameters, widths: Array) -> Array:
    """Return the mean fraction of the stroke (3,) that a spool dithered by `widths` (3,) opens to each side.

    This is the mean beyond the dead band over a whole period of the spool's second-order model, from the
    square wave's Fourier series.
    """
    shares = np.zeros(3)
    turn = np.linspace(0.0, 2.0 * pi, 400, endpoint=False)[:, np.newaxis]
    order = np.arange(1, _HARMONICS, 2)
    for i, (actuator, period) in enumerate(zip(plant.actuators, dither_periods(plant), strict=True)):
        valve = actuator.valve
        relative = 2.0 * pi * order / period / valve.natural_frequency
        follows = 1.0 / (1.0 - relative**2 + 2j * valve.damping_ratio * relative)
        series = 4.0 / (pi * order) * np.imag(follows * np.exp(1j * order * turn))
        opening = widths[i] * series.sum(axis=1)
        shares[i] = np.maximum(opening - valve.dead_band, 0.0).mean() / (1.0 - valve.dead_band)
    return shares


def _force(plant: PlantParameters, i: int, share: float) -> float:
    """Return the force (N, shoulder N m) of actuator `i`, its chamber A filled for `share` of the time."""
    actuator, atmosphere = plant.actuators[i], plant.supply.atmosphere
    in_a, in_b = _balance(plant, i, share), _balance(plant, i, 1.0 - share)
    return (in_a - atmosphere) * actuator.area_a - (in_b - atmosphere) * actuator.area_b


def _shortfall(plant: PlantParameters, i: int, load: float, share: float) -> float:
    return load - _force(plant, i, share)


def _net(plant: PlantParameters, i: int, share: float, pressure: float) -> float:
    """Return what flows into a chamber at `pressure` (Pa), filled for `share` of the time, in m' R T (W)."""
    valve, supply = plant.actuators[i].valve, plant.supply
    into = flow(valve.conductance, supply.pressure, pressure, valve.critical_ratio)
    out = flow(valve.conductance, pressure, supply.atmosphere, valve.critical_ratio)
    return share * into - (1.0 - share) * out


def _balance(plant: PlantParameters, i: int, share: float) -> float:
    """Return the pressure (Pa) at which as much flows in as out, filled for `share` of the time."""
    supply = plant.supply
    return falling_root(partial(_net, plant, i, share), supply.atmosphere, supply.pressure)


def falling_root(falling: Callable[[float], float], low: float, high: float) -> float:
    """Return where `falling` changes its sign from + to -, by bisection."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if falling(middle) > 0.0 else (low, middle)
    return 0.5 * (low + high)
