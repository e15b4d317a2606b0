"""The thesis' recipe (section 2.4 of it: the controller block), on the simulated plant, joint by joint.

1. Increase P until overshoot is achieved.
2. Increase D until the overshoot is eliminated.
3. Increase I until the static error is eliminated.

Each trial is a step of one joint's reference from the address, from one and the same instant. The thesis
took the gains found for the first joint for all three; here each joint gets its own, as it recommends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.gains import Gains
from bench.control.settings import ControlSettings, build_controller
from bench.simulation.engine import Mark
from bench.simulation.series import Bench, Series, quiet, settled
from bench.swing.profile import Profile
from bench.tuning.gains import gains_of, with_gains

Array = NDArray[np.float64]

STEP = (-0.10, -0.04, -0.10)
"""rad, away from the stops."""
_BEFORE, _AFTER, _END = 0.05, 1.2, 0.2
"""s: before the step, after it, and of its end that counts as static."""
_OVERSHOOT, _GONE, _AGAIN = 0.02, 0.01, 0.10
"""Shares of the step: achieved, eliminated, and too much while the integral gain is raised."""
_FASTER = 1.25
_MOST = 60
"""Trials of one gain."""


class StepTrial(NamedTuple):
    """One step of a joint."""

    joint: int
    rule: int
    """1 to 3, of the recipe."""
    gains: Gains
    overshoot: float
    """Share of the step; infinite if the trial was stopped."""
    static_error: float
    """rad"""


class Recipe(NamedTuple):
    """Gains that the recipe found."""

    gains: Gains
    trials: tuple[StepTrial, ...]
    missed: tuple[tuple[int, int], ...]
    """Joint and rule whose goal was not reached."""


class Steps:
    """The bench's model, ready to step any joint from one and the same instant."""

    def __init__(self, bench: Bench) -> None:
        """Arm the model and let it settle at the address; Refused if it does not reach it."""
        self._bench = bench
        self._series, self._mark = _at_address(bench)

    def step(self, gains: Gains, joint: int, rule: int) -> StepTrial:
        """Return the trial of a step of `joint` with `gains`; nothing else opens the valves."""
        bench, profile = self._bench, step_profile(self._bench.profile, joint)
        control = with_gains(_bare(bench.control), gains)
        envelope = replace(bench.envelope, following={}, model=replace(bench.envelope.model, check="off"))
        parameters = build_controller(bench.model, profile, control, envelope, bench.estimator)
        swing = self._series.swing_from(self._mark, profile, ball=False, parameters=parameters)
        begin, tick = round(_BEFORE / profile.period), profile.period
        way = (swing.cycles["plant_angle"][:, joint] - profile.angle[0, joint]) / STEP[joint]
        if swing.cause:
            return StepTrial(joint, rule, gains, np.inf, np.inf)
        static = abs(1.0 - way[-round(_END / tick) :].mean()) * abs(STEP[joint])
        return StepTrial(joint, rule, gains, float(way[begin:].max() - 1.0), float(static))


def _at_address(bench: Bench) -> tuple[Series, Mark]:
    return settled(bench, quiet(bench.model), swings=0)


def _bare(control: ControlSettings) -> ControlSettings:
    return replace(control, feed_forward="none", dither=(0.0, 0.0, 0.0))


def step_profile(profile: Profile, joint: int) -> Profile:
    """Return a profile that holds the address of `profile` and then steps `joint` by STEP."""
    before, samples = (round(time / profile.period) for time in (_BEFORE, _BEFORE + _AFTER))
    angle = np.tile(profile.angle[0], (samples, 1))
    angle[before:, joint] += STEP[joint]
    return replace(
        profile,
        name="step",
        begins=(0, 1, *range(samples - 5, samples)),
        angle=angle,
        velocity=np.zeros((samples, 3)),
        valve=np.zeros((samples, 3)),
        blind_brake=np.zeros(((samples - 1) // profile.blind_spacing + 1, 6)),
    )


def tune_by_recipe(
    bench: Bench, on_trial: Callable[[StepTrial], None] = lambda trial: None, steps: Steps | None = None
) -> Recipe:
    """Return the gains that the recipe finds on the bench's own model; the acceleration's damping stays.

    Deterministic. `on_trial` gets each trial.

    Raises:
        Refused: the model does not reach its address.
    """
    steps = steps or Steps(bench)
    gains, trials, missed = gains_of(bench.control), list[StepTrial](), list[tuple[int, int]]()

    def note(trial: StepTrial) -> StepTrial:
        trials.append(trial)
        on_trial(trial)
        return trial

    for joint in range(3):
        band = bench.model.actuators[joint].valve.dead_band
        rest = bench.control.rest_band[joint]
        gains = gains.with_joint(joint, integral=0.0, derivative=0.0)
        # 1. until overshoot
        for proportional in _rising(2.0 * band / abs(STEP[joint])):
            gains = gains.with_joint(joint, proportional=proportional)
            if note(steps.step(gains, joint, 1)).overshoot >= _OVERSHOOT:
                break
        else:
            missed.append((joint, 1))
        # 2. until it is gone; otherwise the trial with the least of it counts
        most = gains.proportional[joint]
        best = trials[-1]
        for derivative in _rising(0.005 * most):
            if derivative > most or best.overshoot <= _GONE:
                break
            trial = note(steps.step(gains.with_joint(joint, derivative=derivative), joint, 2))
            best = min(best, trial, key=lambda trial: trial.overshoot)
        gains = best.gains
        if best.overshoot > _GONE:
            missed.append((joint, 2))
        # 3. until the static error is gone, or the overshoot is back
        best = trials[-1]._replace(gains=gains, static_error=best.static_error)
        for integral in _rising(0.05 * most):
            if best.static_error <= rest:
                break
            trial = note(steps.step(gains.with_joint(joint, integral=integral), joint, 3))
            if trial.overshoot > _AGAIN:
                break
            best = min(best, trial, key=lambda trial: trial.static_error)
        gains = best.gains
        if best.static_error > rest:
            missed.append((joint, 3))
    return Recipe(gains, tuple(trials), tuple(missed))


def _rising(start: float) -> Iterator[float]:
    yield from (start * _FASTER**k for k in range(_MOST))
