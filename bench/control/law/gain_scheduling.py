"""Gains from the machine: poles of each joint's loop, placed on the robot's linear model, pose by pose.

The spool position u admits air, and air moves the joint against the air's own spring. From rest, with the
others held, joint i moves by:

    q''' + c q'' + k b q' = b u

c is the friction's damping (1/s), b the jerk at u = 1 (rad/s3). 1 / k is the steady joint speed at u = 1
(rad/s). Damping, derivative and proportional gains make it

    q''' + a2 q'' + a1 q' + a0 (q - reference) = 0
    a2 = the joint's bandwidth, a1 = max(k b, shape a2^2), a0 = stiffness a1 a2 / 4

so that poles stay in one relation at any pose. How large a2 can be is a matter of what delays the loop:
spool, estimator, encoder and tick, which no pose changes. So it is one number a joint, as large as lets every
pose of the grid keep the required margins, all three loops closed (`bench.control.law.linear_loop`).

Inertia that a joint feels lies between that with the others held and that with the others free. Bandwidths
are placed for the first, and the required margins are those of the whole.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from itertools import product
from math import prod, radians
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.estimate.estimator import ESTIMATOR_PARAMETERS
from bench.control.law.gain_table import SHAPE, Gains, gain_record
from bench.control.law.linear_loop import (
    Complex,
    Estimator,
    LinearPlant,
    at_rest,
    estimator_response,
    least_damping,
    linearised,
    linearize,
    loop_responses,
    margins_of,
    steady_estimator,
)
from drivers.base.compiled import new_record
from sim.driver import joint_travel
from sim.plant import Plant, PlantParameters, build_plant

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

_ENDS = 0.02
"""Fraction of the travel at either end that the grid leaves out: gas in a chamber is stiffest there."""
_JUDGED = (1, 2, 2)
"""Every so many poses of the grid bandwidths are chosen by."""
_COARSE = 2 * np.pi * np.geomspace(1.0, 450.0, 160)
"""Frequencies of the first search (rad/s)."""
_STIFFNESS = 1.2
_BEGIN = (
    ((0.1, 2.0), (0.14, 3.0), (0.28, 0.25)),
    ((0.1, 0.5), (0.14, 0.5), (0.2, 0.25)),
    ((0.06, 0.5), (0.08, 0.25), (0.14, 0.25)),
)
"""Rates times delay, and shapes, that searches begin with; a later one where those before fail."""
_KEPT = 1.05
"""Factor on the required margins at the evaluated poses: between them margins may be lower."""
_SHAPES = (0.125, 4.0)
"""Range of the shapes; above it joints follow a little more stiffly and oscillate for longer."""
_STEPS = (1.4, 1.12)
_TOGETHER = ((0,), (1,), (2,), (0, 1, 2), (0, 1), (0, 2), (1, 2))
_INTEGRAL = 0.125
"""Rate of the integral, as a fraction of that of the loop's slowest pole."""
_OPENED = 1.2
"""Required movement of the spool, in dead bands, that the max error at the address leads to."""


class RequiredMargins(NamedTuple):
    """Margins that every loop keeps at every pose."""

    gain: float = 2.0
    phase: float = radians(30.0)
    delay: float = 0.003
    damping_ratio: float = 0.1


class Bandwidth(NamedTuple):
    """How the poles of one joint's loop lie."""

    rate: float
    """a2, 1/s"""
    shape: float
    """a1 over the square of a2, at least."""


Bandwidths = tuple[Bandwidth, Bandwidth, Bandwidth]


class WorstMargin(NamedTuple):
    """The margin with the lowest ratio to the required one."""

    share: float
    """Ratio to the required margin; negative where a mode grows."""
    name: str
    value: float
    """Factor, rad, s or damping ratio."""
    joint: int
    """Joint of the loop; -1 for the damping of all."""
    angle: Array
    """(3,) rad, the pose."""


class MachineGains(NamedTuple):
    """Gains over the pose, and how far they keep the required margins."""

    table: np.ndarray[Any, Any]
    """PID_PARAMETERS, shared by all callers."""
    bandwidths: Bandwidths
    delay: Array
    """(3,) s, of spool, reading and tick."""
    worst: WorstMargin
    """Worst margin at the poses that set the bandwidths; a ratio below 1: the machine allows no more."""


class JointChains(NamedTuple):
    """The chain of each joint at one pose; (3,) each."""

    authority: Array
    """b, rad/s3"""
    slowness: Array
    """k, s/rad"""
    friction: Array
    """c, 1/s"""


def machine_gains(
    plant: PlantParameters, filters: np.ndarray[Any, Any], tolerance: Triple, timeout: float
) -> MachineGains:
    """Return the gains for `plant`, its angles estimated by `filters` (an ESTIMATOR_PARAMETERS record).

    The integral moves the spool out of its dead band within half of `timeout` (s) at an error of `tolerance`
    (3,) rad. Deterministic; about a second for a machine seen for the first time.
    """
    return _designed(_as_moved(plant), filters.tobytes(), tolerance, timeout / 2)


def _as_moved(plant: PlantParameters) -> PlantParameters:
    """Return `plant` without what its linear model does not know."""
    known = PlantParameters()
    encoders = replace(known.encoders, latency=plant.encoders.latency)
    return replace(plant, encoders=encoders, ball=known.ball, site=known.site, seed=known.seed)


def pose_grid(plant: PlantParameters) -> tuple[Array, Array]:
    """Return the lowest pose (3,) rad of the table's grid and the distances of its poses (3,) rad."""
    lower, upper = joint_travel(plant)
    left = _ENDS * (upper - lower)
    return lower + left, (upper - lower - 2 * left) / (np.array(SHAPE) - 1)


@lru_cache(maxsize=16)
def _designed(plant: PlantParameters, filters: bytes, tolerance: Triple, timeout: float) -> MachineGains:
    built = build_plant(plant)
    record = new_record(ESTIMATOR_PARAMETERS)
    record[:] = np.frombuffer(filters, ESTIMATOR_PARAMETERS)
    estimator = steady_estimator(record, plant.tick, plant.encoders.latency)
    lower, spacing = pose_grid(plant)
    local = {at: joint_chains(built, lower + spacing * at) for at in np.ndindex(SHAPE)}
    judged = product(*(range(0, n, step) for n, step in zip(SHAPE, _JUDGED, strict=True)))
    poses = [(local[at], linearize(built, at_rest(built, lower + spacing * at), _COARSE)) for at in judged]
    bands = np.array([actuator.valve.dead_band for actuator in plant.actuators])
    opened = _Opened(bands, np.array(tolerance), timeout)
    delay = _delay(plant)
    bandwidths, worst = _best(
        _search(poses, estimator, opened, _scaled(begin, delay), plant.tick) for begin in _BEGIN
    )
    table = np.zeros((*SHAPE, len(Gains._fields), 3))
    for at in np.ndindex(SHAPE):
        table[at] = _placed(local[at], bandwidths, opened)
    record = gain_record(lower, spacing, plant.supply.pressure, table)
    return MachineGains(record, bandwidths, delay, worst)


def _delay(plant: PlantParameters) -> Array:
    """Return by what spools, readings and ticks delay each loop, (3,) s."""
    lag = [2 * a.valve.damping_ratio / a.valve.natural_frequency for a in plant.actuators]
    return np.array(lag) + plant.encoders.latency + 1.5 * plant.tick


def joint_chains(plant: Plant, angle: Array) -> JointChains:
    """Return the chains at `angle` (3,) rad, other joints held."""
    motion, spool = linearised(plant, at_rest(plant, angle))
    by_pressure, flow = motion[3:6, 6:12], spool[6:12]
    by_spool, by_speed = by_pressure @ flow, -by_pressure @ motion[6:12, 3:6]
    held = np.linalg.inv(by_spool)
    return JointChains(
        1.0 / np.diag(held), np.diag(held @ by_speed).copy(), -np.diag(motion[3:6, 3:6]).copy()
    )


class _Opened(NamedTuple):
    """Dead bands, tolerances and time that set the minimum of the integral gains."""

    band: Array
    """(3,) dead bands."""
    tolerance: Array
    """(3,) rad"""
    time: float
    """Integral time (s)."""


def _placed(local: JointChains, bandwidths: Bandwidths, opened: _Opened) -> Array:
    """Return the gains (5, 3) that place the poles at one pose."""
    rate = np.array([one.rate for one in bandwidths])
    shape = np.array([one.shape for one in bandwidths])
    spring = local.slowness * local.authority
    a2 = np.maximum(rate, local.friction)
    a1 = np.maximum(spring, shape * a2**2)
    proportional = _STIFFNESS * a1 * a2 / 4 / local.authority
    slowest = _STIFFNESS * a2 / 4
    needed = (_OPENED * opened.band / opened.tolerance - proportional) / opened.time
    integral = np.maximum(_INTEGRAL * slowest * proportional, needed)
    derivative, damping = (a1 - spring) / local.authority, (a2 - local.friction) / local.authority
    return np.array([proportional, integral, derivative, damping, local.slowness])


def _gains(local: JointChains, bandwidths: Bandwidths, opened: _Opened) -> Gains:
    a, b, c, d, e = (tuple(row.tolist()) for row in _placed(local, bandwidths, opened))
    return Gains(a, b, c, d, e)


def _worst(
    poses: list[tuple[JointChains, LinearPlant]],
    estimator: Estimator,
    bandwidths: Bandwidths,
    opened: _Opened,
    period: float,
    at_least: float = -np.inf,
) -> WorstMargin:
    """Return the worst margin over `poses`, by its ratio to the required one.

    No more poses are tried once it is below `at_least`; the pose that was worst is the first next time.
    """
    found, estimated = list[WorstMargin](), estimator_response(estimator, _COARSE, period)
    for k, (local, frozen) in enumerate(poses):
        gains = _gains(local, bandwidths, opened)
        found.append(worst_margin(frozen, estimator, estimated, gains, period, at_least))
        if found[-1].share < at_least:
            poses.insert(0, poses.pop(k))
            break
    return min(found, key=lambda one: one.share)


def worst_margin(
    frozen: LinearPlant,
    estimator: Estimator,
    estimated: Complex,
    gains: Gains,
    period: float,
    at_least: float = -np.inf,
) -> WorstMargin:
    """Return the worst margin of the loops with `gains` at one instant, by its ratio to the required one.

    `estimated` is the `estimator_response`. Once a margin is below `at_least` the damping is not looked at.
    """
    required, angle = RequiredMargins(), frozen.point.motion[:3]
    worst = WorstMargin(np.inf, "", np.inf, -1, angle)
    responses = loop_responses(frozen, estimated, gains, period)
    for joint in range(3):
        margins = margins_of(frozen.frequency, responses[:, joint])
        for name in ("gain", "phase", "delay"):
            share = getattr(margins, name) / getattr(required, name)
            if share < worst.share:
                worst = WorstMargin(share, f"{name} margin", getattr(margins, name), joint, angle)
    if worst.share < at_least:
        return worst
    damped = least_damping(frozen, estimator, gains, period)
    share = damped / required.damping_ratio
    return worst if worst.share <= share else WorstMargin(share, "damping ratio", damped, -1, angle)


def _search(
    poses: list[tuple[JointChains, LinearPlant]],
    estimator: Estimator,
    opened: _Opened,
    begin: Bandwidths,
    period: float,
) -> tuple[Bandwidths, WorstMargin]:
    """Return bandwidths that keep the margins, as stiff as single steps lead, and the worst margin."""
    found, worst = begin, _worst(poses, estimator, begin, opened, period)
    for step in _STEPS:
        better = True
        while better:
            better = False
            for tried in _neighbours(found, step):
                stiffer = _stiffness(tried) > 1.001 * _stiffness(found)
                if tried == found or (worst.share >= _KEPT and not stiffer):
                    continue
                reached = _worst(poses, estimator, tried, opened, period, at_least=min(worst.share, _KEPT))
                nearer = worst.share < _KEPT and reached.share > worst.share
                if nearer or (stiffer and min(reached.share, worst.share) >= _KEPT):
                    found, worst, better = tried, reached, True
    return found, worst


def _scaled(begin: tuple[tuple[float, float], ...], delay: Array) -> Bandwidths:
    """Return bandwidths whose rates are those of `begin`, times the loops' `delay` (3,) s."""
    a, b, c = (Bandwidth(rate / d, shape) for (rate, shape), d in zip(begin, delay.tolist(), strict=True))
    return a, b, c


def _best(tried: Iterable[tuple[Bandwidths, WorstMargin]]) -> tuple[Bandwidths, WorstMargin]:
    """Return the first that keeps its margins, or the one that comes nearest to that."""
    found = list[tuple[Bandwidths, WorstMargin]]()
    for one in tried:
        found.append(one)
        if one[1].share >= _KEPT:
            return one
    return max(found, key=lambda one: one[1].share)


def _neighbours(found: Bandwidths, step: float) -> list[Bandwidths]:
    """Return bandwidths one step away: rates of one, two or all joints, shapes of one."""
    rates = [[step if k in joints else 1.0 for k in range(3)] for joints in _TOGETHER]
    moves = [(factors, [1.0] * 3) for factors in rates]
    moves += [([1.0] * 3, [step**2 if k == joint else 1.0 for k in range(3)]) for joint in range(3)]
    return [_moved(found, rate, shape, side) for rate, shape in moves for side in (1, -1)]


def _moved(found: Bandwidths, rates: list[float], shapes: list[float], side: int) -> Bandwidths:
    a, b, c = (
        Bandwidth(one.rate * rate**side, min(max(one.shape * shape**side, _SHAPES[0]), _SHAPES[1]))
        for one, rate, shape in zip(found, rates, shapes, strict=True)
    )
    return a, b, c


def _stiffness(bandwidths: Bandwidths) -> float:
    """Return how stiff the loops are, all joints together."""
    return prod(one.rate**3 * one.shape for one in bandwidths)
