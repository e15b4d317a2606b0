"""filterpy's Kalman filter with the parameters of ours: the independent check of the compiled estimator."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.estimate.estimator import ESTIMATOR_STATE, design_estimator, estimate
from drivers.base.compiled import new_record

Array = NDArray[np.float64]


class Samples(NamedTuple):
    """Encoder samples of n ticks; joints in order."""

    angle: Array
    """Sampled angles (n, 3) (rad)."""
    age: Array
    """Ages of the samples when a tick uses them (n, 3) (s)."""
    valid: NDArray[np.uint8]
    """Whether there is a sample (n, 3)."""
    interval: Array
    """Time since the previous tick (n,) (s)."""
    window: NDArray[np.bool_]
    """Whether a tick is in the impact window (n,)."""


class Estimates(NamedTuple):
    """Values of one joint after each tick."""

    state: Array
    """Angle, velocity, acceleration (n, 3) (rad, rad/s, rad/s²)."""
    covariance: Array
    """Upper triangle of the covariance (n, 6)."""
    innovation: Array
    """Innovation (n,) (rad); 0 without a sample."""


def filterpy_estimates(samples: Samples, parameters: np.ndarray[Any, Any], joint: int) -> Estimates:
    """Return the estimates of filterpy for `joint` from the tick after its first sample on.

    `parameters` is an ESTIMATOR_PARAMETERS record.
    """
    from filterpy.common import Q_continuous_white_noise, Q_discrete_white_noise  # it brings scipy.stats
    from filterpy.kalman import KalmanFilter

    own = {name: parameters[name][0, joint] for name in parameters.dtype.names or ()}
    first = int(np.argmax(samples.valid[:, joint]))
    kalman = KalmanFilter(dim_x=3, dim_z=1)
    kalman.x = np.array([[samples.angle[first, joint]], [0.0], [0.0]])
    kalman.P = np.diag(own["initial_variance"])
    states, covariances, innovations = [], [], []
    for k in range(first + 1, len(samples.angle)):
        t, age, valid = samples.interval[k], samples.age[k, joint], samples.valid[k, joint]
        kalman.F = np.array([[1.0, t, t * t / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
        kalman.Q = Q_discrete_white_noise(3, t, own["density"] * t)
        if samples.window[k]:
            kalman.Q[:2, :2] += Q_continuous_white_noise(2, t, own["jump_density"])
        kalman.predict()
        kalman.H = np.array([[1.0, -age, age**2 / 2]])
        kalman.R = np.array([[own["quantisation"] + (kalman.x[1, 0] * own["jitter"]) ** 2]])
        kalman.update(samples.angle[k, joint] if valid else None)
        states.append(kalman.x[:, 0].copy())
        covariances.append(kalman.P[np.triu_indices(3)])
        innovations.append(kalman.y[0, 0] if valid else 0.0)
    return Estimates(np.array(states), np.array(covariances), np.array(innovations))


def velocity_difference(ticks: int = 400) -> float:
    """Return the max difference (rad/s) of the compiled velocity from filterpy's over a synthetic downswing.

    The shoulder turns with up to 40 rad/s and 16 bits per turn; one sample in nine is missing.
    """
    period, turn = 1e-3, 2 * np.pi / 2**16
    time = period * np.arange(ticks)
    angle = np.round(np.tile((1 - np.cos(20 * time))[:, None], 3) * 2 / turn) * turn
    valid = np.tile((np.arange(ticks) % 9 != 5)[:, None], 3).astype(np.uint8)
    interval, window = np.full(ticks, period), np.abs(np.arange(ticks) - ticks // 2) < 6
    samples = Samples(angle, np.full((ticks, 3), 2e-4), valid, interval, window)
    parameters = design_estimator(period=period, counts_per_revolution=2**16)
    state = new_record(ESTIMATOR_STATE)
    velocity = np.empty(ticks)
    for k in range(ticks):
        estimate(state, parameters, angle[k], samples.age[k], valid[k], period, bool(window[k]))
        velocity[k] = state["velocity"][0, 0]
    return float(np.abs(velocity[1:] - filterpy_estimates(samples, parameters, 0).state[:, 1]).max())
