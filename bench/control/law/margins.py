"""Stability margins of a loop: gain, phase and delay, from its frequency response."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
