"""Gains by margins: for each joint the max proportional gain whose loop keeps the required margins.

Too small a gain leaves the spool in its dead band, and the robot short of its address: gains that
`reaches_address` rules out are not tried.
"""

from __future__ import annotations

from collections.abc import Callable
from math import radians
from typing import NamedTuple

import numpy as np

from bench.control.settings import ControlSettings
from bench.tuning.gains import Gains
from bench.tuning.linear_loop import FREQUENCIES, Estimator, Frozen, least_damping, loop_response
from bench.tuning.margins import margins_of
from sim.plant import PlantParameters

_ROUNDS = 2
_OPENED = 1.2
"""Required movement of the spool, in dead bands."""
_PROPORTIONAL = np.geomspace(2.5, 0.2, 24).tolist()
_DERIVATIVE = (0.25, 0.5, 1.0, 1.4, 2.0)
_DAMPING = (0.0, 0.25, 0.5, 1.0, 1.5)
"""Factors on the initial gains; the integral gain keeps its share of the proportional one."""


class Wanted(NamedTuple):
    """Required margins at every instant up to the top."""

    gain: float = 2.0
    phase: float = radians(30.0)
    delay: float = 0.003
    damping_ratio: float = 0.1


class Tuned(NamedTuple):
    """Gains that were found."""

    gains: Gains
    met: tuple[float, float, float]
    """By joint: the worst share of a required margin that is reached, at most 1."""


def met_share(
    plants: list[Frozen], estimator: Estimator, gains: Gains, joint: int, period: float, wanted: Wanted
) -> float:
    """Return the worst share of `wanted` that the loop of `joint` reaches: 1 at most, negative when it grows.

    `plants` are the instants to judge by.
    """
    worst = 1.0
    for frozen in plants:
        response = loop_response(frozen, estimator, gains, joint, period)
        margins = margins_of(FREQUENCIES, response)
        shares = (margins.gain / wanted.gain, margins.phase / wanted.phase, margins.delay / wanted.delay)
        worst = min(worst, *shares)
    for frozen in plants:
        worst = min(worst, least_damping(frozen, estimator, gains, period) / wanted.damping_ratio)
    return worst


def reaches_address(gains: Gains, joint: int, plant: PlantParameters, control: ControlSettings) -> bool:
    """Return whether the max error at the address opens the valve within half the time-out."""
    opened = gains.proportional[joint] + gains.integral[joint] * control.move_timeout / 2
    return opened * control.address_tolerance[joint] >= _OPENED * plant.actuators[joint].valve.dead_band


def tune_by_margins(
    plants: list[Frozen],
    estimator: Estimator,
    plant: PlantParameters,
    control: ControlSettings,
    wanted: Wanted | None = None,
    progress: Callable[[float], None] = lambda part: None,
) -> Tuned:
    """Return gains of all joints; where `wanted` cannot be reached, those that come nearest to it.

    Deterministic: a search over fixed factors on the gains of `control`, joint by joint, twice round. No
    joint gains at another's cost: the loops share the plant's damping.
    """
    start = Gains.of(control)
    wanted, gains, period = wanted or Wanted(), start, plant.tick
    judged = [frozen for frozen in plants if frozen.point.judged]
    before = [met_share(judged, estimator, start, joint, period, wanted) for joint in range(3)]
    met, done, all_ = list(before), 0, _ROUNDS * 3 * len(_DERIVATIVE) * len(_DAMPING)
    for _ in range(_ROUNDS):
        for joint in range(3):
            found: list[tuple[float, float, Gains]] = []
            for derivative in _DERIVATIVE:
                for damping in _DAMPING:
                    for factor in _PROPORTIONAL:
                        tried = gains.with_joint(
                            joint,
                            proportional=factor * start.proportional[joint],
                            integral=factor * start.integral[joint],
                            derivative=derivative * start.derivative[joint],
                            damping=damping * start.damping[joint],
                        )
                        if not reaches_address(tried, joint, plant, control):
                            break
                        share = met_share(judged, estimator, tried, joint, period, wanted)
                        found.append((round(share, 6), factor, tried))
                        if share >= 1.0:
                            break  # smaller ones are no better
                    done += 1
                    progress(done / all_)
            others = [other for other in range(3) if other != joint]
            for share, _, tried in sorted(found, key=lambda one: one[:2], reverse=True):
                kept = (met_share(judged, estimator, tried, k, period, wanted) >= before[k] for k in others)
                if all(kept):
                    gains, met[joint] = tried, share
                    break
    return Tuned(gains, (met[0], met[1], met[2]))
