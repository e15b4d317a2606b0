"""The loop, linearised at instants of a swing: arms, air and spools, the estimator, the PIDs, tick by tick.

At each instant the motion is frozen: angles, speeds, pressures and openings are those of the simulated swing.
Joints slide (dry friction has no slope), spools are beyond their dead band (where the dither carries them),
end stops are not touched. Modes slower than `_SLOWEST` are not judged: within a swing they do not come to
show. Up to the top this tells how the loop behaves. At the top dry friction holds the joints, and the
downswing ends before most of the growing modes of a frozen instant matter: reported, but not judged.
"""

from __future__ import annotations

from math import cos, sin
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from bench.control.estimator import design_estimator
from bench.control.settings import EstimatorSettings
from bench.errors import BenchError
from bench.lifecycle import CAUSE_TEXT
from bench.simulation.series import Bench, Series, quiet
from bench.tuning.gains import Gains
from bench.tuning.margins import Margins, margins_of
from sim.kane import accelerations, kane_terms
from sim.kinematics import right_arm_length
from sim.motion import chambers
from sim.plant import Plant, PlantParameters

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

FREQUENCIES = 2 * np.pi * np.geomspace(1.0, 450.0, 600)
"""rad/s at which responses are taken."""
_SLOWEST = 2 * np.pi
"""rad/s"""
_MOTION = 12
"""Angles, speeds, pressures."""
_STEPS = np.concatenate([np.full(3, 1e-6), np.full(3, 1e-5), np.full(6, 10.0)])
_OPENED = 0.005


class Point(NamedTuple):
    """An instant of a swing."""

    name: str
    motion: Array
    """(12,) angles rad, speeds rad/s, chamber pressures Pa."""
    supply: float
    opening: Array
    damping: float
    """Share of the damping gain that acts here."""
    judged: bool
    """Whether the loop behaves as linearised here: the motion is slow, and dry friction does not hold it."""


class Frozen(NamedTuple):
    """The linear plant at an instant, between a command and the next reading."""

    point: Point
    transition: Array
    """(18, 18) over a tick."""
    input: Array
    """(18, 3)"""
    output: Array
    """(3, 18) rad, angles as late as the encoders."""
    response: Complex
    """(n, 3, 3) at FREQUENCIES, from commands to readings."""


class Estimator(NamedTuple):
    """The three Kalman filters with their steady gains."""

    transition: Array
    """(3, 3, 3)"""
    gain: Array
    """(3, 3)"""


class JointLoop(NamedTuple):
    """One joint's loop at one instant."""

    point: str
    joint: int
    margins: Margins


class Judged(NamedTuple):
    """All loops with some gains."""

    loops: tuple[JointLoop, ...]
    damping_ratio: dict[str, float]
    """Min damping ratio of the closed loop's modes, by instant; negative where one grows."""


def operating_points(bench: Bench) -> list[Point]:
    """Return instants of the bench's swing on its own model.

    Raises:
        BenchError: the swing is stopped.
        Refused: the robot does not reach its address.
    """
    profile, plant = bench.profile, quiet(bench.model)
    _, backswing, top, down, _, window, _ = profile.begins
    instants = {
        "address": 0,
        "backswing 1/3": backswing + (top - backswing) // 3,
        "backswing 2/3": backswing + 2 * (top - backswing) // 3,
        "top": down - 1,
        "downswing 1/3": down + (window - down) // 3,
        "downswing 2/3": down + 2 * (window - down) // 3,
        "at the ball": window - 1,
    }
    series = Series(bench, plant)
    series.swing(profile)
    swing = series.swing(profile)
    if swing.cause:
        raise BenchError(
            f"a swing of {profile.name}",
            f"stopped: {CAUSE_TEXT[swing.cause]}",
            "a whole swing on the model",
            "Take a profile of this configuration.",
        )
    points = []
    for name, tick in instants.items():
        cycle = swing.cycles[tick]
        motion = np.concatenate([cycle[f"plant_{kind}"] for kind in ("angle", "velocity", "pressure")])
        share = bench.control.downswing_damping if tick >= down else 1.0
        supply = float(cycle["supply_pressure"])
        points.append(Point(name, motion, supply, cycle["applied_valve"].copy(), share, tick < down - 1))
    return points


def _rates(plant: Plant, motion: Array, supply: float, opening: Array) -> Array:
    """Return the rates (12,) of `motion`, spools `opening` (3,) beyond their dead band, no dry friction."""
    p, parameters, r = plant.plant[0], plant.parameters, plant.robot[0]
    angle, speed = motion[:3], motion[3:6]
    y, dy = np.zeros(13), np.zeros(13)
    y[6:12], y[12] = motion[6:], supply
    arm_lever = kane_terms(r, *angle, *speed)[9]
    wrist_lever = parameters.wrist_lever * cos(angle[2])
    positions = (
        angle[0],
        float(right_arm_length(parameters.robot, angle[1])) - parameters.robot.l56,
        parameters.wrist_lever * sin(angle[2]),
    )
    levers, forces = (1.0, arm_lever, wrist_lever), np.zeros(3)
    for i, actuator in enumerate(parameters.actuators):
        band = actuator.valve.dead_band
        spool = np.sign(opening[i]) * (band + (1 - band) * abs(opening[i]))
        moving = levers[i] * speed[i]
        force, _ = chambers(p, i, y, dy, spool, positions[i], moving, 0.0)
        forces[i] = force - actuator.friction.viscous * moving
    efforts = (forces[0], forces[1], forces[2] * wrist_lever)
    rates = accelerations(r, angle[0], angle[1], angle[2], speed[0], speed[1], speed[2], *efforts)
    return np.concatenate([speed, rates, dy[6:12]])


def freeze(plant: Plant, point: Point) -> Frozen:
    """Return `plant` linearised at `point`."""
    parameters = plant.parameters
    bands = np.array([a.valve.dead_band for a in parameters.actuators])
    beyond = np.sign(point.opening) * np.maximum(np.abs(point.opening) - bands, 0.0) / (1 - bands)
    states = _MOTION + 6
    matrix, command = np.zeros((states, states)), np.zeros((states, 3))
    for k, step in enumerate(_STEPS):
        shift = np.zeros(_MOTION)
        shift[k] = step
        above, below = (
            _rates(plant, point.motion + side * shift, point.supply, beyond) for side in (1.0, -1.0)
        )
        matrix[:_MOTION, k] = (above - below) / (2 * step)
    for i, actuator in enumerate(parameters.actuators):
        shift = np.zeros(3)
        shift[i] = _OPENED
        above, below = (
            _rates(plant, point.motion, point.supply, beyond + side * shift) for side in (1.0, -1.0)
        )
        matrix[:_MOTION, _MOTION + i] = (above - below) / (2 * _OPENED) / (1 - bands[i])
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
    shift = np.exp(1j * FREQUENCIES * parameters.tick)[:, None, None] * np.eye(states)
    response = np.asarray(output @ np.linalg.solve(shift - transition, driven), dtype=complex)
    return Frozen(point, transition, driven, output, response)


def steady_estimator(plant: PlantParameters, settings: EstimatorSettings) -> Estimator:
    """Return the estimator's filters once their gains have settled."""
    counts, period, age = plant.encoders.counts_per_revolution, plant.tick, plant.encoders.latency
    record = design_estimator(
        period=period,
        counts_per_revolution=(counts,) * 3,
        noise=settings.noise,
        jitter=settings.jitter,
        acceleration_change=settings.acceleration_change,
        velocity_jump=settings.velocity_jump,
    )
    ahead = np.array([[1.0, period, period**2 / 2], [0.0, 1.0, period], [0.0, 0.0, 1.0]])
    seen = np.array([[1.0, -age, age**2 / 2]])
    spread = np.array([[period**2 / 2], [period], [1.0]])
    transition, gain = np.zeros((3, 3, 3)), np.zeros((3, 3))
    for i in range(3):
        noise = record["density"][0, i] * period * spread @ spread.T
        covariance, weight = np.diag(record["initial_variance"][0, i]), np.zeros((3, 1))
        for _ in range(2000):
            covariance = ahead @ covariance @ ahead.T + noise
            weight = covariance @ seen.T / (seen @ covariance @ seen.T + record["quantisation"][0, i])
            covariance = (np.eye(3) - weight @ seen) @ covariance
            covariance = (covariance + covariance.T) / 2
        gain[i], transition[i] = weight[:, 0], (np.eye(3) - weight @ seen) @ ahead
    return Estimator(transition, gain)


def _controllers(estimator: Estimator, gains: Gains, share: float, period: float) -> Complex:
    """Return the responses (n, 3) from readings to commands, less their sign."""
    z = np.exp(1j * FREQUENCIES * period)
    answers = np.zeros((len(z), 3), complex)
    for i in range(3):
        matrix = np.eye(3) - estimator.transition[i] / z[:, None, None]
        estimates = np.linalg.solve(matrix, np.broadcast_to(estimator.gain[i][:, None], (len(z), 3, 1)))
        integral = gains.integral[i] * period * z / (z - 1)
        answers[:, i] = (
            (gains.proportional[i] + integral) * estimates[:, 0, 0]
            + gains.derivative[i] * estimates[:, 1, 0]
            + share * gains.damping[i] * estimates[:, 2, 0]
        )
    return answers


def loop_response(frozen: Frozen, estimator: Estimator, gains: Gains, joint: int, period: float) -> Complex:
    """Return the response (n,) of one joint's loop, opened at its valve, the other two closed."""
    ratio = _controllers(estimator, gains, frozen.point.damping, period)[:, :, None] * frozen.response
    others = [i for i in range(3) if i != joint]
    among = np.eye(2) + ratio[:, others][:, :, others]
    back = np.linalg.solve(among, ratio[:, others][:, :, [joint]])
    return np.asarray(ratio[:, joint, joint] - (ratio[:, [joint]][:, :, others] @ back)[:, 0, 0])


def least_damping(frozen: Frozen, estimator: Estimator, gains: Gains, period: float) -> float:
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
    rates = rates[np.abs(rates) > _SLOWEST]
    return float((-rates.real / np.abs(rates)).min())


def judge(
    plants: list[Frozen], estimator: Estimator, gains: Gains, period: float, joints: Any = range(3)
) -> Judged:
    """Return the margins of the loops of `joints` at all instants, and how the closed loop is damped."""
    loops = []
    for frozen in plants:
        for i in joints:
            response = loop_response(frozen, estimator, gains, i, period)
            loops.append(JointLoop(frozen.point.name, i, margins_of(FREQUENCIES, response)))
    ratios = {frozen.point.name: least_damping(frozen, estimator, gains, period) for frozen in plants}
    return Judged(tuple(loops), ratios)
