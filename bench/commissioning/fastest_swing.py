"""The swing of a robot that was found: how fast it can swing, and swings of a share of that speed.

A whole swing is designed at rising speeds until the design fails: collocation, refinement on the plant,
closed loop, the cushions if the ball is missed or the bench falls silent. All are near the shipped swing's
downswing, slower ones in as much more time; the backswing may be slower than the shipped one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import radians
from typing import NamedTuple

from bench.config import Configuration
from bench.design.designer import DesignFailed, SwingDemand, design_swing
from bench.design.golfer_tracking import demand_near
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile

ATTACK = radians(2.0)
"""Attack angle of the shipped swings, rad."""
_NEAR = "default"
"""Shipped swing whose downswing is followed."""
_STEP, _FINE = 1.08, 1.04
"""Factors between two speeds that are tried, and between the fastest found and the slowest failed one."""
_TEMPI = ((0.85, 0.25), (1.1, 0.25), (1.1, 0.4))
"""Durations of backswing and top that are tried in turn, s: the first is too fast for some robots."""
_LEAST_LEVER = 0.34
"""Min |sin beta| of the plan, 0.2 rad before the envelope's 0.15: right robots were seen 0.12 rad off."""
_SLOWEST, _FASTEST = 20.0, 60.0
"""m/s between which speeds are tried."""

Progress = Callable[[str], None]


class FastestSwing(NamedTuple):
    """The fastest swing that was designed."""

    profile: Profile
    speed: float
    """m/s"""
    limit: str
    """Why a higher speed failed."""


def design_at(configuration: Configuration, speed: float, name: str, start: Profile | None = None) -> Profile:
    """Return a swing at `speed` (m/s) for the configured robot, beginning the search with `start`.

    Where none is found a slower backswing is tried.

    Raises:
        DesignFailed: no design succeeds; the reason is that of the first.
        BenchError: the package casadi is not installed.
    """
    c, near = configuration, load_profile(find_profile(_NEAR))
    demand = demand_near(
        c.plant, near, SwingDemand(head_speed=speed, attack=ATTACK, least_lever=_LEAST_LEVER)
    )
    slower = near.delivery["head_speed_mps"] / speed
    shortest, longest = demand.downswing_time
    demand = replace(demand, downswing_time=(shortest * slower, longest * max(slower, 1.0)))
    failures = list[DesignFailed]()
    for backswing, top in _TEMPI:
        try:
            asked = replace(demand, backswing_time=backswing, top_time=top)
            return design_swing(c, asked, name, start=start or near).profile
        except DesignFailed as failure:
            failures.append(failure)
    raise failures[0]


def fastest_swing(configuration: Configuration, progress: Progress = lambda what: None) -> FastestSwing:
    """Return the fastest swing that the designer finds for the configured robot.

    Raises:
        DesignFailed: no design succeeds.
        BenchError: the package casadi is not installed.
    """
    found: Profile | None = None
    speed = load_profile(find_profile(_NEAR)).delivery["head_speed_mps"]
    done, failed, limit = 0.0, float("inf"), "faster swings are not tried"
    while _SLOWEST <= speed <= _FASTEST and failed > _FINE * done:
        progress(f"{speed:.1f} m/s")
        try:
            found = design_at(configuration, speed, "fastest", found)
            done = speed
        except DesignFailed as failure:
            failed, limit = speed, f"at {speed:.1f} m/s {failure}"
        if failed == float("inf"):
            speed = done * _STEP
        elif done == 0.0:
            speed = failed / _STEP
        else:
            speed = (done * failed) ** 0.5
    if found is None:
        raise DesignFailed(limit)
    return FastestSwing(found, done, limit)
