"""Joint angle, velocity and acceleration from encoder samples: one Kalman filter per joint.

Model (filterpy's kinematic filter of order 2): x = [angle, velocity, acceleration], between ticks the
acceleration is constant, at each tick it changes by white noise,

    F = [[1, dt, dt²/2], [0, 1, dt], [0, 0, 1]],   Q = Q_discrete_white_noise(3, dt, density·dt).

`density` (rad²/s⁵) is the variance of that change per second, so that one long tick and several short ones
let the covariance grow alike; at the design period Q is Q_discrete_white_noise(3, period, change²).
`reference_filter` is filterpy's filter with the same parameters.

Why order 2: on a synthetic downswing (wrist to 38 rad/s at up to 1500 rad/s², 1 kHz, 2^16 counts) the best
order 1 filter's wrist speed is 0.11 rad/s rms wrong and 0.16 ms late, this one's 0.06 rad/s and 0.01 ms.

Inside the impact window Q grows by velocity jumps of variance jump² at an instant spread evenly over
the tick, which is Q_continuous_white_noise(2, dt, jump²/period) on angle and velocity. A wrist speed that
drops by 12 rad/s is known to 0.5 rad/s in the third tick and 0.2 in the fourth. Multiplying Q by a factor
instead is worse: 1000 makes the filter ring at several rad/s from tick to tick, because Q has rank 1.

A sample is `age` old when the tick uses it: its measurement function is H = [1, -age, age²/2], exact
in this model for an age up to one tick. A missing sample is a prediction with growing covariance.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.base.compiled import compiled, fields, new_record

ESTIMATOR_PARAMETERS = np.dtype(
    [
        *fields("f8", "quantisation jitter density jump_density", (3,)),
        ("initial_variance", "f8", (3, 3)),
    ],
    align=True,
)
"""Per joint: variance of the encoder's rounding and noise (rad²); standard deviation of a sample's time (s);
variance of the acceleration's change per second (rad²/s⁵); variance of the velocity's jumps per second
inside the impact window (rad²/s³); variances of angle, velocity and acceleration after the first sample."""

ESTIMATOR_STATE = np.dtype(
    [
        *fields("f8", "angle velocity acceleration", (3,)),
        ("covariance", "f8", (3, 6)),
        *fields("f8", "innovation innovation_variance normalised_innovation without_sample", (3,)),
        ("started", "u1", (3,)),
    ],
    align=True,
)
"""Per joint: rad, rad/s, rad/s²; the covariance's upper triangle (00, 01, 02, 11, 12, 22); the last
sample's innovation (rad), its variance and their ratio innovation/√variance, all zero in a tick without a
sample; seconds since the last sample; 1 once there was one. A sample called valid that is not finite is not
used and leaves NaN as its normalised innovation."""


_INITIAL_VELOCITY, _INITIAL_ACCELERATION = 1.0, 10.0
"""Standard deviations of velocity (rad/s) and acceleration (rad/s²) at the first sample."""


def design_estimator(
    *,
    period: float,
    counts_per_revolution: int,
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0),
    jitter: tuple[float, float, float] = (0.0, 0.0, 0.0),
    acceleration_change: tuple[float, float, float] = (50.0, 50.0, 100.0),
    velocity_jump: tuple[float, float, float] = (0.3, 0.3, 1.0),
) -> np.ndarray[Any, Any]:
    """Return an ESTIMATOR_PARAMETERS record for ticks of about `period` (s); tuples are in joint order.

    Standard deviations: `noise` of a sample without its rounding (rad), `jitter` of a sample's time (s),
    `acceleration_change` in one period (rad/s²), `velocity_jump` in one period of the impact window (rad/s).

    Raises:
        ValueError: a standard deviation is not finite or outside its meaning.
    """
    values = np.array([jitter, acceleration_change, velocity_jump, noise], dtype=float)
    if not (np.all(np.isfinite(values)) and np.all(values >= 0) and np.all(values[1] > 0)):
        raise ValueError(
            "estimator: noise, jitter and velocity_jump must be at least 0, acceleration_change above 0, "
            f"all finite; found {noise}, {jitter}, {velocity_jump}, {acceleration_change}"
        )
    parameters = new_record(ESTIMATOR_PARAMETERS)
    rounding = (2.0 * np.pi / counts_per_revolution) ** 2 / 12.0
    for joint in range(3):
        parameters["quantisation"][0, joint] = rounding + noise[joint] ** 2
        parameters["jitter"][0, joint] = jitter[joint]
        parameters["density"][0, joint] = acceleration_change[joint] ** 2 / period
        parameters["jump_density"][0, joint] = velocity_jump[joint] ** 2 / period
    parameters["initial_variance"] = rounding, _INITIAL_VELOCITY**2, _INITIAL_ACCELERATION**2
    return parameters


@compiled
def estimate(
    state: np.ndarray[Any, Any],
    parameters: np.ndarray[Any, Any],
    angle: np.ndarray[Any, Any],
    age: np.ndarray[Any, Any],
    valid: np.ndarray[Any, Any],
    dt: float,
    in_impact_window: bool,
) -> None:
    """Move all three filters on by `dt` (s, measured) and take in the samples, in place.

    `angle` (3,) rad, `age` (3,) s before this tick, `valid` (3,) nonzero where the sample is to be used.
    The first sample starts a filter at rest. Allocates nothing, never raises, reads no clock; a
    non-finite `dt` makes the estimate NaN, for the envelope to see.
    """
    s = state[0]
    p = parameters[0]
    for i in range(3):
        sample = valid[i] != 0 and np.isfinite(angle[i]) and np.isfinite(age[i])
        s.innovation[i] = 0.0
        s.innovation_variance[i] = 0.0
        s.normalised_innovation[i] = np.nan if valid[i] != 0 and not sample else 0.0
        s.without_sample[i] = 0.0 if sample else s.without_sample[i] + dt
        if s.started[i] == 0:
            if sample:
                _start(s, p, i, angle[i])
            continue
        _predict(s, p, i, dt, in_impact_window)
        if sample:
            _update(s, p, i, angle[i], age[i])


@compiled
def _start(s: Any, p: Any, i: int, angle: float) -> None:
    """Start filter `i` at rest at its first sample."""
    s.angle[i] = angle
    s.velocity[i] = 0.0
    s.acceleration[i] = 0.0
    s.covariance[i, 0] = p.initial_variance[i, 0]
    s.covariance[i, 1] = 0.0
    s.covariance[i, 2] = 0.0
    s.covariance[i, 3] = p.initial_variance[i, 1]
    s.covariance[i, 4] = 0.0
    s.covariance[i, 5] = p.initial_variance[i, 2]
    s.started[i] = 1


@compiled
def _predict(s: Any, p: Any, i: int, dt: float, in_impact_window: bool) -> None:
    """Set x = F x, P = F P Fᵀ + Q for filter `i`."""
    half = 0.5 * dt * dt
    s.angle[i] += dt * s.velocity[i] + half * s.acceleration[i]
    s.velocity[i] += dt * s.acceleration[i]

    c = s.covariance
    a00 = c[i, 0] + dt * c[i, 1] + half * c[i, 2]  # a = F P
    a01 = c[i, 1] + dt * c[i, 3] + half * c[i, 4]
    a02 = c[i, 2] + dt * c[i, 4] + half * c[i, 5]
    a11 = c[i, 3] + dt * c[i, 4]
    a12 = c[i, 4] + dt * c[i, 5]
    q = p.density[i] * dt
    j = p.jump_density[i] if in_impact_window else 0.0
    c[i, 0] = a00 + dt * a01 + half * a02 + q * half * half + j * dt * dt * dt / 3.0
    c[i, 1] = a01 + dt * a02 + q * half * dt + j * half
    c[i, 2] = a02 + q * half
    c[i, 3] = a11 + dt * a12 + q * dt * dt + j * dt
    c[i, 4] = a12 + q * dt
    c[i, 5] += q


@compiled
def _update(s: Any, p: Any, i: int, angle: float, age: float) -> None:
    """Take one sample into filter `i`; P in Joseph's form, which stays positive after long silences."""
    h1 = -age
    h2 = 0.5 * age * age
    c = s.covariance
    p00, p01, p02, p11, p12, p22 = c[i, 0], c[i, 1], c[i, 2], c[i, 3], c[i, 4], c[i, 5]
    n0, n1, n2 = h1 * p01 + h2 * p02, h1 * p11 + h2 * p12, h1 * p12 + h2 * p22
    m0, m1, m2 = p00 + n0, p01 + n1, p02 + n2  # m = P Hᵀ
    blur = s.velocity[i] * p.jitter[i]  # angle that the sample's time leaves open
    r = p.quantisation[i] + blur * blur
    variance = m0 + h1 * m1 + h2 * m2 + r
    k0, k1, k2 = m0 / variance, m1 / variance, m2 / variance
    y = angle - (s.angle[i] + h1 * s.velocity[i] + h2 * s.acceleration[i])

    s.angle[i] += k0 * y
    s.velocity[i] += k1 * y
    s.acceleration[i] += k2 * y
    s.innovation[i] = y
    s.innovation_variance[i] = variance
    s.normalised_innovation[i] = y / np.sqrt(variance)

    # Joseph: (I-KH) P (I-KH)ᵀ + K R Kᵀ = B - (B Hᵀ - K R) Kᵀ with B = (I-KH) P = P - K mᵀ.
    # Its first row keeps the factor 1 - k0, whose rounding then cancels as in filterpy's product.
    d = 1.0 - k0
    b00, b01, b02 = d * p00 - k0 * n0, d * p01 - k0 * n1, d * p02 - k0 * n2
    b10, b11, b12 = p01 - k1 * m0, p11 - k1 * m1, p12 - k1 * m2
    b20, b21, b22 = p02 - k2 * m0, p12 - k2 * m1, p22 - k2 * m2
    e0 = b00 + h1 * b01 + h2 * b02 - k0 * r
    e1 = b10 + h1 * b11 + h2 * b12 - k1 * r
    e2 = b20 + h1 * b21 + h2 * b22 - k2 * r
    c[i, 0] = b00 - e0 * k0
    c[i, 1] = b01 - e0 * k1
    c[i, 2] = b02 - e0 * k2
    c[i, 3] = b11 - e1 * k1
    c[i, 4] = b12 - e1 * k2
    c[i, 5] = b22 - e2 * k2
