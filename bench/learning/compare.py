"""Controllers compared on one swing and one robot: tracking, delivery and cost of each.

All start alike: armed, held and brought back by the bench's own controller, so that the robot, its air and
its random numbers are the same; only the swing itself is the compared controller's. Following errors do not
stop it, or most rows would be empty; the row states where the envelope would have stopped it. All other
limits still apply.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.base.lifecycle import Cause, Phase
from bench.control.settings import ControlSettings, EnvelopeSettings, PidSettings, build_controller
from bench.control.step_records import ControlParameters
from bench.learning.delivery import UNKNOWN, Figures, figures_of, planned_figures
from bench.learning.learn import LearningProblem, learn, on_series, prepare
from bench.simulation.series import Bench, Series, SeriesSwing
from bench.swing.profile import Profile
from bench.swing.thesis_experiment import DERIVATIVE, INTEGRAL, PROPORTIONAL
from sim.kinematics import forward_kinematics
from sim.plant import PlantParameters
from sim.pneumatics import REFERENCE_DENSITY

Array = NDArray[np.float64]

_NONE = (0.0, 0.0, 0.0)
LITRES = 1000.0 / REFERENCE_DENSITY
"""Litres of free air (ANR: 20 °C, 1 bar, ISO 8778) in a kilogram."""
_FOLLOWED = (Phase.BACKSWING, Phase.TOP, Phase.DOWNSWING, Phase.COMMITTED)


class Controller(NamedTuple):
    """One of the compared controllers."""

    name: str
    control: ControlSettings
    sensors: bool = False
    """Whether the chambers have pressure sensors."""
    velocity_weight: float = 1.0
    """Weight of the reference's velocity in the derivative; 0: the derivative of the measurement alone."""


class Compared(NamedTuple):
    """One controller: the mean of its swings."""

    controller: str
    figures: Figures
    """Unknown if no swing struck the ball without a stop."""
    error: Figures
    """Figures less the planned ones; that of the speed as a share."""
    tracking: Array
    """Root mean square of reference less true angle in the downswing, up to a stop, (3,) rad."""
    path: float
    """Root mean square of the head's distance from its reference, m."""
    saturated: float
    """Share of the downswing's ticks in which a valve stood at its limit."""
    air: float
    """Air used per swing, kg."""
    cause: Cause
    """Cause of the last stop; ADDRESS_TIMEOUT if the robot does not rest at its address; else NONE."""
    strayed: tuple[int, Phase] | None
    """Joint and phase in which the envelope's following error is first exceeded; None if it is not."""


def thesis_gains(plant: PlantParameters) -> PidSettings:
    """Return the thesis' P = 1000, I = 0.92, D = 1 as openings.

    Its controllers put out N m, N and N m; opening 1 is the force at full supply pressure.
    """
    gauge, levers = plant.supply.pressure - plant.supply.atmosphere, (1.0, 1.0, plant.wrist_lever)
    a, b, c = (
        gauge * actuator.area_a * lever for actuator, lever in zip(plant.actuators, levers, strict=True)
    )
    return PidSettings(*((gain / a, gain / b, gain / c) for gain in (PROPORTIONAL, INTEGRAL, DERIVATIVE)))


def controllers(bench: Bench) -> list[Controller]:
    """Return the controllers in the order in which they are compared, each with one thing more."""
    whole = bench.control
    alone = replace(
        whole, gains="hand", pid=thesis_gains(bench.model), feed_forward="none", damping=_NONE, dither=_NONE
    )
    inverted = replace(whole, feed_forward="kane+pneumatic")
    return [
        Controller("PID, thesis' gains", alone, velocity_weight=0.0),
        Controller("PID", replace(whole, feed_forward="none")),
        Controller("+ Kane", replace(whole, feed_forward="kane")),
        Controller("+ valves inverted", inverted),
        Controller("+ pressure sensors", inverted, sensors=True),
        Controller("PID, planned", replace(whole, feed_forward="planned")),
    ]


def problem_of(bench: Bench, progress: Callable[[float], None] = lambda part: None) -> LearningProblem:
    """Return the learning problem with the planned openings as feed-forward, which learning corrects.

    Raises:
        BenchError: the profile lacks its planned delivery; the modelled swing is stopped or misses the ball.
        Refused: the model does not reach its address.
    """
    bench = bench._replace(control=replace(bench.control, feed_forward="planned"))
    return prepare(bench, progress)


def compare(
    bench: Bench,
    plant: PlantParameters,
    swings: int = 3,
    problem: LearningProblem | None = None,
    on_start: Callable[[str], None] = lambda name: None,
) -> list[Compared]:
    """Return a row for each of `controllers`, and with a `problem` one for learning, on the robot `plant`.

    Each arms and swings once before its swings count. `on_start` gets the name of the next one.

    Raises:
        BenchError: the profile lacks its planned delivery.
    """
    planned, rows = planned_figures(bench), []
    loose = bench._replace(envelope=replace(bench.envelope, max_following_error={}))
    for controller in controllers(bench):
        on_start(controller.name)
        truth = replace(plant, pressure_sensors=controller.sensors)
        try:
            rows.append(_compared(controller, loose, truth, bench.envelope, planned, swings))
        except Refused:
            rows.append(_no_address(controller.name))
    if problem is not None:
        name = "+ learning"
        on_start(name)
        try:
            rows.append(_learned(name, problem, replace(plant, pressure_sensors=False), planned, swings))
        except Refused:
            rows.append(_no_address(name))
    return rows


def _no_address(name: str) -> Compared:
    nothing = float("nan")
    return Compared(
        name, UNKNOWN, UNKNOWN, np.full(3, nothing), nothing, nothing, nothing, Cause.ADDRESS_TIMEOUT, None
    )


def _compared(
    controller: Controller,
    bench: Bench,
    plant: PlantParameters,
    envelope: EnvelopeSettings,
    planned: Figures,
    swings: int,
) -> Compared:
    # Held by the bench's own gains; the observer of the pressures needs the time before the swing.
    holding = replace(bench.control, feed_forward=controller.control.feed_forward)
    series = Series(bench._replace(control=holding), plant)
    swung = _parameters(bench, controller)
    series.swing(bench.profile, swung)
    made = [series.swing(bench.profile, swung) for _ in range(swings)]
    return _row(controller.name, made, bench, envelope, planned)


def _learned(
    name: str, problem: LearningProblem, plant: PlantParameters, planned: Figures, swings: int
) -> Compared:
    bench = problem.bench
    series = Series(bench, plant)
    result = learn(problem, on_series(problem, series))
    learned = result.correction.applied_to(bench.profile)
    series.swing(learned)
    made = [series.swing(learned) for _ in range(swings)]
    return _row(f"{name}, {result.chosen}", made, bench, bench.envelope, planned)


def _parameters(bench: Bench, controller: Controller) -> ControlParameters:
    envelope = replace(bench.envelope, model=replace(bench.envelope.model, check="off"))
    made = build_controller(bench.model, bench.profile, controller.control, envelope, bench.estimator)
    made.pid["reference_velocity_weight"] = controller.velocity_weight
    return made


def _row(
    name: str, made: list[SeriesSwing], bench: Bench, envelope: EnvelopeSettings, planned: Figures
) -> Compared:
    profile, robot = bench.profile, bench.model.robot
    figures = np.array([figures_of(swing.delivery).array for swing in made])
    errors, away, saturated = [], [], []
    for swing in made:
        down = swing.cycles[profile.begins[3] : profile.begins[5]]
        down = down[down["cause"] == 0]
        errors.append(down["reference_angle"] - down["plant_angle"])
        reference = forward_kinematics(robot, down["reference_angle"])[:, :2]
        away.append(np.hypot(*(reference - down["plant_head_position"]).T))
        saturated.append(np.abs(down["applied_valve"]).max(axis=1) >= envelope.max_opening)
    struck = np.isfinite(figures).all(axis=1) & [_delivered(swing, profile) for swing in made]
    mean = figures[struck].mean(axis=0) if struck.any() else UNKNOWN.array
    error = mean - planned.array
    error[1] /= planned.speed
    stops = [swing.cause for swing in made if swing.cause]
    return Compared(
        name,
        Figures(*map(float, mean)),
        Figures(*map(float, error)),
        _root_mean_square(np.concatenate(errors)),
        float(_root_mean_square(np.concatenate(away)[:, None])[0]),
        float(np.mean(np.concatenate(saturated))) if len(np.concatenate(saturated)) else float("nan"),
        float(np.mean([swing.air_used for swing in made])),
        stops[-1] if stops else Cause.NONE,
        next((found for swing in made if (found := strayed(swing.cycles, envelope))), None),
    )


def _delivered(swing: SeriesSwing, profile: Profile) -> bool:
    """Return whether the contact is the swing's: in its downswing or later, and before any stop."""
    stops = np.flatnonzero(swing.cycles["cause"] != 0)
    end = stops[0] if len(stops) else len(swing.cycles)
    return profile.begins[3] <= swing.contact_time / profile.period <= end


def _root_mean_square(values: Array) -> Array:
    """Return the root mean square of each column of `values` (n, k); NaN without rows."""
    return (
        np.asarray(np.sqrt(np.mean(values**2, axis=0))) if len(values) else np.full(values.shape[1], np.nan)
    )


def strayed(cycles: np.ndarray[Any, Any], envelope: EnvelopeSettings) -> tuple[int, Phase] | None:
    """Return joint and phase in which a following error is first greater than `envelope` allows, or None."""
    found: list[tuple[int, int, Phase]] = []
    error = np.abs(cycles["reference_angle"] - cycles["angle"])
    running = cycles["reaction"] == 0
    for phase in (*_FOLLOWED, Phase.FOLLOW_THROUGH):
        limits = envelope.max_following_error.get(phase.name.lower())
        if limits is None:
            continue
        beyond = (error > np.array(limits)) & (running & (cycles["phase"] == phase))[:, None]
        if beyond.any():
            tick, joint = (int(i) for i in np.argwhere(beyond)[0])
            found.append((tick, joint, phase))
    return min(found)[1:] if found else None
