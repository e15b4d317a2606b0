"""The closed loop of a robot linearised at an instant: estimator and PIDs, tick by tick, and its margins.

Modes slower than `_MIN_FREQUENCY` are not judged: within a swing they do not come to show.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from bench.control.law.gain_table import Gains
from bench.control.law.linear_plant import Complex, LinearPlant

Array = NDArray[np.float64]

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
