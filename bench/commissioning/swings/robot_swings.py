"""Swings of the robot that was found, and the limits for them.

A whole swing is designed at rising speeds until the design fails: collocation, refinement on the plant,
closed loop, shock absorbers after a missed ball or a loss of communication. All are near the downswing of
the default profile, slower ones in as much more time; the backswing may be slower.

A slower swing follows the path of a designed one, with its reference stretched in time. A design at less than
half the speed is not reliable: its plan spends most of its time near the top, where dry friction decides. A
stretched swing need not be a good shot.

Limits of the following error come from how its model follows the swing. The configured ones are those of
another robot: one with more friction or smaller valves lags further behind its reference in a healthy swing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.base.lifecycle import Phase
from bench.commissioning.machine.commissioning_step import LEARNED_FILE, Arm, StepResult, SwingingStep
from bench.commissioning.machine.machine import at_rows
from bench.config import Configuration
from bench.control.law.gain_table import MOVE, gains_along
from bench.control.residual_thresholds import limits_path, save_limits
from bench.control.settings import pid_record
from bench.design.designer import DesignFailed, design_swing
from bench.design.golfer_tracking import demand_near
from bench.design.optimal_control import SwingDemand
from bench.design.threshold_generation import DRAWS, make_limits
from bench.simulation.simulated_bench import Bench, Series
from bench.simulation.sweep import local_engine
from bench.swing.library import find_profile
from bench.swing.profile import Profile, as_written, load_profile

ATTACK = radians(2.0)
"""Attack angle of the shipped swings, rad."""
_NEAR = "default"
"""Shipped swing whose downswing is followed."""
_STEP, _FINE = 1.08, 1.04
"""Factors between two speeds that are tried, and between the fastest found and the slowest failed one."""
_TEMPI = ((0.85, 0.25), (1.1, 0.25), (1.1, 0.4))
"""Durations of backswing and top that are tried in turn, s: the first is too fast for some robots."""
_MIN_LEVER = 0.34
"""Min |sin beta| of the plan, 0.2 rad before the envelope's 0.15: right robots were seen 0.12 rad off."""
_MIN_SPEED, _MAX_SPEED = 20.0, 60.0
"""Range of the speeds that are tried (m/s)."""

Progress = Callable[[str], None]


class FastestSwing(NamedTuple):
    """The fastest swing that was designed."""

    profile: Profile
    speed: float
    """Head speed (m/s)."""
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
    demand = demand_near(c.plant, near, SwingDemand(head_speed=speed, attack=ATTACK, least_lever=_MIN_LEVER))
    slower = near.delivery["head_speed_mps"] / speed
    shortest, longest = demand.downswing_time
    demand = replace(demand, downswing_time=(shortest * slower, longest * max(slower, 1.0)))
    failures = list[DesignFailed]()
    for backswing, top in _TEMPI:
        try:
            asked = replace(demand, backswing_time=backswing, top_time=top)
            return design_swing(c, asked, name, start=start or near)
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
    while _MIN_SPEED <= speed <= _MAX_SPEED and failed > _FINE * done:
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


_PATTERN = 3
"""Columns of the openings in the blind brakes' table; the rest are durations."""


def slowed(profile: Profile, share: float, configuration: Configuration) -> Profile:
    """Return `profile` at `share` (0 to 1) of its speed from the backswing on.

    Its openings are those that move the joints on at the reference's speed.
    """
    c = configuration
    begin, rows = profile.begins[1], len(profile.angle)
    stretched = begin + round((rows - 1 - begin) / share) + 1
    at = np.concatenate([np.arange(begin), begin + share * np.arange(stretched - begin)])
    angle = at_rows(profile.angle, at)
    velocity = np.gradient(angle, profile.period, axis=0)
    velocity[:begin] = 0.0
    gain = gains_along(pid_record(c.control, c.estimator, c.plant), angle)[:, MOVE]
    nearest = at[:: profile.blind_spacing] // profile.blind_spacing
    blind = profile.blind_brake[nearest.astype(int)]
    blind[:, _PATTERN:] *= share  # less motion is left to brake
    begins = tuple(row if row <= begin else begin + round((row - begin) / share) for row in profile.begins)
    time = begin * profile.period
    return as_written(
        replace(
            profile,
            name=f"{profile.name} at {100 * share:.0f} %",
            begins=begins,
            angle=angle,
            velocity=velocity,
            valve=np.clip(velocity * gain, -1.0, 1.0),
            blind_brake=blind,
            impact_time=time + (profile.impact_time - time) / share,
            delivery={},
            limits={},
        )
    )


_ROOM = 1.5
"""Times the model's following error that are allowed at least."""
_DIGITS = 3
"""Decimals of a limit, as written and as computed."""


def with_following_limits(known: Configuration, profile: Profile) -> Configuration:
    """Return `known` with following limits that leave `profile` room on its model; none is lower than before.

    Raises:
        Refused: the model does not come to its address.
    """
    free = replace(known.envelope.with_model_check("off"), max_following_error={})
    bench = Bench.of(replace(known, envelope=free), profile)
    cycles = Series(bench, bench.plant).swing(profile, ball=True).cycles
    return replace(known, envelope=replace(known.envelope, max_following_error=_limits(known, cycles)))


def _limits(known: Configuration, cycles: np.ndarray[Any, Any]) -> dict[str, tuple[float, float, float]]:
    errors = np.abs(cycles["angle"] - cycles["reference_angle"])
    wider = {}
    for name, limits in known.envelope.max_following_error.items():
        in_phase = errors[cycles["phase"] == Phase[name.upper()]]
        needed = _ROOM * in_phase.max(axis=0, initial=0.0)
        a, b, c = np.maximum(np.round(needed, _DIGITS), limits).tolist()
        wider[name] = (a, b, c)
    return wider


def make_healthy_limits(
    known: Configuration, profile: Profile, file: Path, progress: Callable[[str], None]
) -> Configuration:
    """Return `known` with limits for `profile`, from robots around it; store them next to `file`.

    Raises:
        Refused: robots without a fault are stopped by the envelope.
    """

    def show(part: float) -> None:
        progress(f"limits: {100 * part:.0f} % of the swings of drawn robots")

    limits = make_limits(Bench.of(known, profile), DRAWS, show, local_engine())
    save_limits(limits_path(file), limits)
    return known.for_profile(profile, file)


def _healthy_limits(
    arm: Arm, known: Configuration, folder: Path, progress: Callable[[str], None]
) -> StepResult:
    """Make the limits of the learned profile in `folder`, and store them next to it.

    Raises:
        Refused: robots without a fault are stopped by the envelope.
    """
    file = folder / LEARNED_FILE
    make_healthy_limits(known, load_profile(file), file, progress)
    return StepResult((), (f"limits from {DRAWS} robots around the measured one, {DRAWS // 2} to learn on",))


LIMITS = SwingingStep(
    "limits",
    "Limits of the model-based check",
    "nothing moves: computed from simulated healthy swings",
    _healthy_limits,
)
"""Limits of the check that compares the robot with its model."""
