"""The robot with its air, linearised at an instant; its closed loops tick by tick, and their margins.

The motion is frozen: angles, speeds, pressures and spool positions stay. Joints slide (dry friction has no
slope), spools are beyond their dead band (where the dither carries them), end stops are not touched. Modes
slower than `_MIN_FREQUENCY` are not judged: within a swing they do not come to show.
"""

from __future__ import annotations

from math import copysign, cos, sin
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.estimate.air import actuator_motion
from bench.control.law.force_reference import actuator_forces
from bench.control.law.gain_table import Gains
from drivers.base.compiled import compiled_with_arrays
from sim.dynamics import chambers
from sim.kane import accelerations
from sim.plant import Plant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

FREQUENCIES = 2 * np.pi * np.geomspace(1.0, 450.0, 600)
"""Frequencies of the responses (rad/s)."""
_MOTION = 12
"""Angles, speeds, pressures."""
_OPENED = 0.005
_CHARGED = 0.75
"""Chamber pressure after the precharge, as a fraction of the supply pressure."""


class OperatingPoint(NamedTuple):
    """An instant of a swing."""

    name: str
    motion: Array
    """(12,) angles rad, speeds rad/s, chamber pressures Pa."""
    supply: float
    opening: Array
    damping: float
    """Fraction of the damping gain that acts here."""
    judged: bool
    """Whether the loop behaves as linearised here: the motion is slow, and dry friction does not hold it."""


class LinearPlant(NamedTuple):
    """The linear plant at an instant, between a command and the next reading."""

    point: OperatingPoint
    transition: Array
    """(18, 18) over a tick."""
    input: Array
    """(18, 3)"""
    output: Array
    """(3, 18) rad, angles as late as the encoders."""
    frequency: Array
    """(n,) rad/s"""
    response: Complex
    """(n, 3, 3) at these frequencies, from commands to readings."""


@compiled_with_arrays
def _set_rates(robot: Any, p: Any, motion: Any, supply: float, opening: Any, air: Any, rates: Any) -> None:
    """Set the `rates` (12,) of `motion`, spools `opening` (3,) beyond their dead band, no dry friction.

    `air` is scratch, (2, 13).
    """
    angle, speed = motion[:3], motion[3:6]
    r = robot[0]
    for k in range(6):  # an assignment to a slice would take numba seconds
        air[0, 6 + k] = motion[6 + k]
    air[0, 12] = supply
    forces = air[0, :3]
    for i in range(3):
        position, moving = actuator_motion(robot, p, angle, speed, i)
        band = p.dead_band[i]
        spool = 0.0 if opening[i] == 0.0 else copysign(band + (1.0 - band) * abs(opening[i]), opening[i])
        force, _ = chambers(p, i, air[0], air[1], spool, position, moving, 0.0)
        forces[i] = force - p.viscous[i] * moving
    wrist = forces[2] * p.lever_cos * cos(angle[2]) - forces[2] * p.lever_sin * sin(angle[2])
    rates[3], rates[4], rates[5] = accelerations(
        r, angle[0], angle[1], angle[2], speed[0], speed[1], speed[2], forces[0], forces[1], wrist
    )
    for i in range(3):
        rates[i] = speed[i]
    for k in range(6, _MOTION):
        rates[k] = air[1, k]


@compiled_with_arrays
def _set_slopes(
    robot: Any, p: Any, motion: Any, supply: float, opening: Any, by_motion: Any, by_spool: Any
) -> None:
    """Set the slopes of the rates by the motion (12, 12) and by the spools (12, 3)."""
    above, below, air = np.zeros(_MOTION), np.zeros(_MOTION), np.zeros((2, 13))
    shifted, opened = motion.copy(), opening.copy()
    for k in range(_MOTION):
        step = 1e-6 if k < 3 else 1e-5 if k < 6 else 10.0
        shifted[k] = motion[k] + step
        _set_rates(robot, p, shifted, supply, opening, air, above)
        shifted[k] = motion[k] - step
        _set_rates(robot, p, shifted, supply, opening, air, below)
        shifted[k] = motion[k]
        for row in range(_MOTION):
            by_motion[row, k] = (above[row] - below[row]) / (2.0 * step)
    for i in range(3):
        opened[i] = opening[i] + _OPENED
        _set_rates(robot, p, motion, supply, opened, air, above)
        opened[i] = opening[i] - _OPENED
        _set_rates(robot, p, motion, supply, opened, air, below)
        opened[i] = opening[i]
        for row in range(_MOTION):
            by_spool[row, i] = (above[row] - below[row]) / (2.0 * _OPENED) / (1.0 - p.dead_band[i])


def at_rest(plant: Plant, angle: Array) -> OperatingPoint:
    """Return the robot held at `angle` (3,) rad by the air in its charged chambers."""
    parameters = plant.parameters
    supply, atmosphere = parameters.supply.pressure, parameters.supply.atmosphere
    charged, still = _CHARGED * supply, np.zeros((1, 3))
    load = actuator_forces(parameters, angle[None], still, still)[0]
    pressure = np.zeros(6)
    for i, actuator in enumerate(parameters.actuators):
        missing = load[i] - (actuator.area_a - actuator.area_b) * (charged - atmosphere)
        pressure[2 * i] = charged + missing / (2 * actuator.area_a)
        pressure[2 * i + 1] = charged - missing / (2 * actuator.area_b)
    motion = np.concatenate([angle, np.zeros(3), np.clip(pressure, 1.2 * atmosphere, supply)])
    return OperatingPoint("at rest", motion, supply, np.zeros(3), 1.0, True)


def linearised(plant: Plant, point: OperatingPoint) -> tuple[Array, Array]:
    """Return the slopes of the motion's rates at `point`: (12, 12) by the motion, (12, 3) by the spools."""
    bands = np.array([a.valve.dead_band for a in plant.parameters.actuators])
    beyond = np.sign(point.opening) * np.maximum(np.abs(point.opening) - bands, 0.0) / (1 - bands)
    by_motion, by_spool = np.zeros((_MOTION, _MOTION)), np.zeros((_MOTION, 3))
    _set_slopes(plant.robot, plant.plant[0], point.motion, point.supply, beyond, by_motion, by_spool)
    return by_motion, by_spool


def linearize(plant: Plant, point: OperatingPoint, frequency: Array = FREQUENCIES) -> LinearPlant:
    """Return `plant` linearised at `point`, with its responses at `frequency` (n,) rad/s."""
    from scipy.linalg import expm  # here, as the processes of a bench linearise nothing

    parameters = plant.parameters
    states = _MOTION + 6
    matrix, command = np.zeros((states, states)), np.zeros((states, 3))
    matrix[:_MOTION, :_MOTION], matrix[:_MOTION, _MOTION : _MOTION + 3] = linearised(plant, point)
    for i, actuator in enumerate(parameters.actuators):
        omega, zeta = actuator.valve.natural_frequency, actuator.valve.damping_ratio
        matrix[_MOTION + i, _MOTION + 3 + i] = 1.0
        matrix[_MOTION + 3 + i, _MOTION + i] = -(omega**2)
        matrix[_MOTION + 3 + i, _MOTION + 3 + i] = -2 * zeta * omega
        command[_MOTION + 3 + i, i] = omega**2
    whole = np.zeros((states + 3, states + 3))
    whole[:states, :states], whole[:states, states:] = matrix, command
    step = expm(whole * parameters.tick)
    output = np.zeros((3, states))
    output[:, :3], output[:, 3:6] = np.eye(3), -parameters.encoders.latency * np.eye(3)
    transition, driven = step[:states, :states], step[:states, states:]
    shift = np.exp(1j * frequency * parameters.tick)[:, None, None] * np.eye(states)
    response = np.asarray(output @ np.linalg.solve(shift - transition, driven), dtype=complex)
    return LinearPlant(point, transition, driven, output, frequency, response)


_MIN_FREQUENCY = 2 * np.pi
"""Lowest natural frequency of a loop (rad/s)."""


class Estimator(NamedTuple):
    """The three Kalman filters with their steady gains."""

    transition: Array
    """(3, 3, 3)"""
    gain: Array
    """(3, 3)"""


def steady_estimator(filters: np.ndarray[Any, Any], period: float, age: float) -> Estimator:
    """Return the filters of an ESTIMATOR_PARAMETERS record once their gains have settled.

    Ticks of `period` (s), samples of `age` (s).
    """
    from scipy.linalg import solve_discrete_are

    ahead = np.array([[1.0, period, period**2 / 2], [0.0, 1.0, period], [0.0, 0.0, 1.0]])
    seen = np.array([[1.0, -age, age**2 / 2]])
    spread = np.array([[period**2 / 2], [period], [1.0]])
    transition, gain = np.zeros((3, 3, 3)), np.zeros((3, 3))
    for i in range(3):
        noise = filters["density"][0, i] * period * spread @ spread.T
        rounding = filters["quantisation"][0, i]
        covariance = solve_discrete_are(ahead.T, seen.T, noise, np.array([[rounding]]))
        weight = covariance @ seen.T / (seen @ covariance @ seen.T + rounding)
        gain[i], transition[i] = weight[:, 0], (np.eye(3) - weight @ seen) @ ahead
    return Estimator(transition, gain)


def estimator_response(estimator: Estimator, frequency: Array, period: float) -> Complex:
    """Return the responses (n, 3, 3) from each reading to its three estimates at `frequency` (n,) rad/s."""
    z = np.exp(1j * frequency * period)
    answers = np.zeros((len(z), 3, 3), complex)
    for i in range(3):
        matrix = np.eye(3) - estimator.transition[i] / z[:, None, None]
        gain = np.broadcast_to(estimator.gain[i][:, None], (len(z), 3, 1))
        answers[:, i] = np.linalg.solve(matrix, gain)[:, :, 0]
    return answers


def loop_responses(frozen: LinearPlant, estimated: Complex, gains: Gains, period: float) -> Complex:
    """Return the response (n, 3) of each joint's loop, opened at its valve, the other two closed.

    `estimated` is the `estimator_response` at the frequencies of `frozen`.
    """
    z = np.exp(1j * frozen.frequency * period)
    proportional, integral, derivative, damping = (np.array(row) for row in gains[:4])
    control = (
        (proportional + integral * period * (z / (z - 1))[:, None]) * estimated[:, :, 0]
        + derivative * estimated[:, :, 1]
        + frozen.point.damping * damping * estimated[:, :, 2]
    )
    ratio = control[:, :, None] * frozen.response
    opened: Complex = np.empty_like(control)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        own_j, own_k = 1 + ratio[:, j, j], 1 + ratio[:, k, k]
        # Feedback through the other two loops: the solution of their two equations.
        to_j, to_k = ratio[:, j, i], ratio[:, k, i]
        both = own_j * own_k - ratio[:, j, k] * ratio[:, k, j]
        of_j = (own_k * to_j - ratio[:, j, k] * to_k) / both
        of_k = (own_j * to_k - ratio[:, k, j] * to_j) / both
        opened[:, i] = ratio[:, i, i] - ratio[:, i, j] * of_j - ratio[:, i, k] * of_k
    return opened


def least_damping(frozen: LinearPlant, estimator: Estimator, gains: Gains, period: float) -> float:
    """Return the min damping ratio of the closed loop's modes; negative if one grows."""
    n = len(frozen.transition)
    size = n + 9 + 3
    estimated = np.zeros((9, size))
    for i in range(3):
        rows = slice(3 * i, 3 * i + 3)
        estimated[rows, n + 3 * i : n + 3 * i + 3] = estimator.transition[i]
        estimated[rows, :n] = np.outer(estimator.gain[i], frozen.output[i])
    summed = np.zeros((3, size))
    summed[:, n + 9 :] = np.eye(3)
    summed += period * estimated[0::3]
    opened = np.zeros((3, size))
    for i in range(3):
        opened[i] = -(
            gains.proportional[i] * estimated[3 * i]
            + gains.derivative[i] * estimated[3 * i + 1]
            + frozen.point.damping * gains.damping[i] * estimated[3 * i + 2]
            + gains.integral[i] * summed[i]
        )
    moved = np.zeros((n, size))
    moved[:, :n] = frozen.transition
    poles = np.linalg.eigvals(np.vstack([moved + frozen.input @ opened, estimated, summed]))
    rates = np.log(poles[np.abs(poles) > 1e-9]) / period
    rates = rates[np.abs(rates) > _MIN_FREQUENCY]
    return float((-rates.real / np.abs(rates)).min())


class Margins(NamedTuple):
    """Margins of one loop with the others closed; infinite where the response never comes near."""

    gain: float
    """Factor by which the gain may rise."""
    lowest_gain: float
    """Factor to which the gain may fall; 0 where it may be switched off."""
    phase: float
    """Phase margin (rad)."""
    delay: float
    """Delay that may be added, s."""
    modulus: float
    """Min distance of the response from -1."""
    crossover: float
    """Highest frequency at which the response is 1, rad/s; 0 where it never is."""


def margins_of(frequency: Array, response: NDArray[np.complex128]) -> Margins:
    """Return the margins of a stable loop with `response` (n,), opened, at rising `frequency` (n,) rad/s."""
    real, imaginary, size = response.real, response.imag, np.abs(response)
    at = np.flatnonzero((imaginary[:-1] * imaginary[1:] < 0) & (real[:-1] < 0) & (real[1:] < 0))
    part = imaginary[at] / (imaginary[at] - imaginary[at + 1])
    crossing = -(real[at] + part * (real[at + 1] - real[at]))
    inside, outside = crossing[crossing < 1], crossing[crossing >= 1]
    level = np.log(size)
    at = np.flatnonzero(level[:-1] * level[1:] <= 0)
    at = at[level[at] != level[at + 1]]
    part = level[at] / (level[at] - level[at + 1])
    phase = np.unwrap(np.angle(response))
    lead = np.mod(phase[at] + part * (phase[at + 1] - phase[at]) + np.pi, 2 * np.pi)
    speed = frequency[at] * (frequency[at + 1] / frequency[at]) ** part
    return Margins(
        gain=float(1 / inside.max()) if len(inside) else np.inf,
        lowest_gain=float(1 / outside.min()) if len(outside) else 0.0,
        phase=float(np.minimum(lead, 2 * np.pi - lead).min()) if len(at) else np.inf,
        delay=float((lead / speed).min()) if len(at) else np.inf,
        modulus=float(np.abs(1 + response).min()),
        crossover=float(speed.max()) if len(at) else 0.0,
    )
