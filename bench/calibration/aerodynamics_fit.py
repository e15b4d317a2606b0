"""Fit of a ball's drag and lift to measured flights: carry, apex and time, or points of the trajectory.

Weighted least squares for two factors on a published coefficient model. The launch is also measured: its
scatter moves carry, apex and time of a flight together, so each flight's residuals are whitened by the
covariance of launch and observation (errors in the variables, linearised). The covariance of the factors
follows from the whitened Jacobian, times chi square per degree of freedom where that exceeds 1 (Birge ratio);
what all flights have in common (calibration of the device) is added through the fit's own sensitivities.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, field
from math import cos, sin
from typing import Any, TypeAlias

import numpy as np
from scipy.optimize import least_squares

from bench.calibration.ball_aerodynamics import BallAerodynamics
from drivers.base import Launch
from sim.aerodynamics import Air
from sim.ball import Ball
from sim.flight import Aerodynamics, Wind, fly, fly_many

Array: TypeAlias = np.ndarray[Any, Any]

MIN_FLIGHTS = 3
_ROUNDS = 2
"""Fits, each with the covariances at the solution before it."""
_DIFFERENCE = 1e-3
"""Relative step of the factors in derivatives."""
_LAUNCH_STEPS = (0.05, 0.001, 5.0)
"""Steps of ball speed (m/s), launch angle (rad) and spin (rad/s) in derivatives."""
_TIME_STEP = 0.02
"""Integration step of carry, apex and time, s: 12 mm of carry and 0.5 ms at most off the finest (tests)."""
_MAX_ERROR = 0.2
"""Standard error of a factor from which the data do not determine it."""
_FIGURES = ("carry", "apex", "time")


@dataclass(frozen=True)
class MeasuredFlight:
    """One flight as a full-flight monitor or an indoor range measured it; SI, None if not measured."""

    launch: Launch
    carry: float | None = None
    apex: float | None = None
    time: float | None = None
    """Flight time until the ball is back at the height of its start, s."""
    points: Array | None = field(default=None, repr=False)
    """Points of the trajectory, shape (n, 3): time s, distance along the launch direction m, height m."""
    air: Air = field(default_factory=Air)
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def observed(self) -> Array:
        """All observations in one row: figures, then distances and heights of the points."""
        figures = [value for name in _FIGURES if (value := getattr(self, name)) is not None]
        if self.points is None:
            return np.array(figures)
        return np.concatenate([figures, self.points[:, 1], self.points[:, 2]])


@dataclass(frozen=True)
class FlightUncertainty:
    """Standard uncertainties of a device: one flight's (scatter), or common to all (calibration)."""

    speed: float
    """Ball speed, m/s."""
    launch_angle: float
    """Launch angle (rad)."""
    spin: float
    """Spin (rad/s)."""
    carry: float
    """Carry (m)."""
    apex: float
    """Height of the apex (m)."""
    time: float
    """Time of flight (s)."""
    point: float
    """Each coordinate of a trajectory's point, m."""

    def of_launch(self) -> Array:
        """Return the standard uncertainties of speed, launch angle and spin."""
        return np.array(astuple(self)[:3])

    def of_observations(self, flight: MeasuredFlight) -> Array:
        """Return the standard uncertainty of each observation of `flight`."""
        figures = [getattr(self, name) for name in _FIGURES if getattr(flight, name) is not None]
        points = 0 if flight.points is None else 2 * len(flight.points)
        return np.array([*figures, *[self.point] * points])


def fit_aerodynamics(
    ball: str,
    flights: Sequence[MeasuredFlight],
    scatter: FlightUncertainty,
    calibration: FlightUncertainty,
    *,
    mass: float,
    radius: float,
    model: Aerodynamics = Aerodynamics.LIBGOLF,
) -> BallAerodynamics:
    """Return drag and lift of `ball` (its `mass` kg, `radius` m) from its `flights`, at least three.

    `scatter` differs from flight to flight, `calibration` is common to all flights.

    Raises:
        ValueError: too few flights or observations, scatter of 0, or data that do not determine both factors.
    """
    dof = _dof(flights, scatter)

    def predict(factors: Array, launches: Sequence[Launch]) -> list[Array]:
        body = Ball(ball, mass, radius, drag_factor=float(factors[0]), lift_factor=float(factors[1]))
        return _predicted(flights, launches, body, model)

    factors, cost, whiteners = _solved(flights, predict, scatter)
    chi_square = 2.0 * cost / dof
    covariance = _covariance(flights, factors, predict, whiteners, calibration, max(1.0, chi_square))
    errors = np.sqrt(np.diag(covariance))
    if not np.all(errors < _MAX_ERROR):
        raise ValueError(
            f"standard errors {errors[0]:.3g} of drag and {errors[1]:.3g} of lift, expected below "
            f"{_MAX_ERROR}: the data do not determine both"
        )
    speeds, spins = ([getattr(f.launch, name) for f in flights] for name in ("speed", "spin"))
    return BallAerodynamics(
        ball=ball,
        mass=mass,
        radius=radius,
        model=model.name,
        drag_factor=float(factors[0]),
        lift_factor=float(factors[1]),
        drag_error=float(errors[0]),
        lift_error=float(errors[1]),
        correlation=float(covariance[0, 1] / (errors[0] * errors[1])),
        flights=len(flights),
        min_speed=min(speeds),
        max_speed=max(speeds),
        min_spin=min(spins),
        max_spin=max(spins),
        chi_square=chi_square,
    )


_Predict: TypeAlias = Callable[[Array, Sequence[Launch]], list[Array]]


def _dof(flights: Sequence[MeasuredFlight], scatter: FlightUncertainty) -> int:
    """Return the degrees of freedom of the fit; ValueError when data or scatter do not suffice."""
    if len(flights) < MIN_FLIGHTS:
        raise ValueError(f"{len(flights)} flights, expected at least {MIN_FLIGHTS}")
    dof = sum(len(flight.observed) for flight in flights) - 2
    if dof < 1:
        raise ValueError("fewer than 3 observations of carry, apex, time or points")
    if any(not np.all(scatter.of_observations(flight) > 0.0) for flight in flights):
        raise ValueError("a scatter of 0: each observation needs a standard uncertainty above 0")
    return dof


def _solved(
    flights: Sequence[MeasuredFlight], predict: _Predict, scatter: FlightUncertainty
) -> tuple[Array, float, list[Array]]:
    """Return the factors, half the sum of the squared whitened residuals, and the whitening matrices."""
    factors, cost, whiteners = np.array([1.0, 1.0]), 0.0, list[Array]()
    for _ in range(_ROUNDS):
        whiteners = _whiteners(flights, factors, predict, scatter)

        def residuals(x: Array, whiteners: list[Array] = whiteners) -> Array:
            return _residuals(flights, predict(x, _launches(flights)), whiteners)

        found = least_squares(
            residuals, factors, bounds=([0.2, 0.2], [3.0, 3.0]), diff_step=[_DIFFERENCE] * 2
        )
        factors, cost = found.x, float(found.cost)
    return factors, cost, whiteners


def _covariance(
    flights: Sequence[MeasuredFlight],
    factors: Array,
    predict: _Predict,
    whiteners: Sequence[Array],
    calibration: FlightUncertainty,
    widening: float,
) -> Array:
    """Return the covariance of the factors: that of the scatter times `widening`, and of the calibration."""
    by_factor = _by_factor(flights, factors, predict, whiteners)
    information = by_factor.T @ by_factor
    if np.linalg.cond(information) > 1e12:
        raise ValueError("the data do not separate drag from lift: add apex, time or points")
    inverse = np.linalg.inv(information)
    common = inverse @ by_factor.T @ _by_common(flights, factors, predict, whiteners, calibration)
    total: Array = widening * inverse + common @ common.T
    return total


def _launches(flights: Sequence[MeasuredFlight], index: int = -1, step: float = 0.0) -> list[Launch]:
    """Return all launches; with `index`, its figure (0 speed, 1 launch angle, 2 spin) greater by `step`."""
    name = ("speed", "launch_angle", "spin")[index]
    return [
        f.launch if index < 0 else f.launch._replace(**{name: getattr(f.launch, name) + step})
        for f in flights
    ]


def _predicted(
    flights: Sequence[MeasuredFlight], launches: Sequence[Launch], ball: Ball, model: Aerodynamics
) -> list[Array]:
    """Return for each flight what its `observed` would be for `ball`; one compiled loop for each air."""
    groups: dict[tuple[Air, tuple[float, float, float]], list[int]] = {}
    for number, flight in enumerate(flights):
        groups.setdefault((flight.air, flight.wind), []).append(number)
    predicted: list[Array] = [np.empty(0)] * len(flights)
    for (air, wind), members in groups.items():
        flown = np.array([launches[n] for n in members])
        rows = fly_many(flown, air, ball, Wind(wind), aerodynamics=model, step=_TIME_STEP)
        for row, n in zip(rows, members, strict=True):
            figures = [float(row[name]) for name in _FIGURES if getattr(flights[n], name) is not None]
            predicted[n] = np.concatenate([figures, _points(flights[n], launches[n], ball, model)])
    return predicted


def _points(flight: MeasuredFlight, launch: Launch, ball: Ball, model: Aerodynamics) -> Array:
    """Return distances and heights of the flight at the times of its measured points."""
    if flight.points is None:
        return np.empty(0)
    path = fly(launch, flight.air, ball, Wind(flight.wind), aerodynamics=model).path
    along = path[:, 1] * cos(launch.direction) + path[:, 3] * sin(launch.direction)
    times = flight.points[:, 0]
    return np.concatenate([np.interp(times, path[:, 0], along), np.interp(times, path[:, 0], path[:, 2])])


def _residuals(
    flights: Sequence[MeasuredFlight], predicted: Sequence[Array], whiteners: Sequence[Array]
) -> Array:
    return np.concatenate(
        [w @ (p - f.observed) for f, p, w in zip(flights, predicted, whiteners, strict=True)]
    )


def _by_launch(flights: Sequence[MeasuredFlight], factors: Array, predict: _Predict) -> list[Array]:
    """Return the derivatives of each flight's observations with respect to speed, launch angle and spin."""
    columns = []
    for index, step in enumerate(_LAUNCH_STEPS):
        above = predict(factors, _launches(flights, index, step))
        below = predict(factors, _launches(flights, index, -step))
        columns.append([(a - b) / (2 * step) for a, b in zip(above, below, strict=True)])
    return [np.column_stack(three) for three in zip(*columns, strict=True)]


def _whiteners(
    flights: Sequence[MeasuredFlight], factors: Array, predict: _Predict, scatter: FlightUncertainty
) -> list[Array]:
    """Return for each flight the matrix that makes its residuals independent with a deviation of 1."""
    found = []
    for flight, slope in zip(flights, _by_launch(flights, factors, predict), strict=True):
        of_launch = slope * scatter.of_launch()
        covariance = of_launch @ of_launch.T + np.diag(scatter.of_observations(flight) ** 2)
        found.append(np.linalg.inv(np.linalg.cholesky(covariance)))
    return found


def _by_factor(
    flights: Sequence[MeasuredFlight], factors: Array, predict: _Predict, whiteners: Sequence[Array]
) -> Array:
    """Return the derivatives of the whitened residuals with respect to the two factors."""
    columns = []
    for index in range(2):
        step = np.zeros(2)
        step[index] = _DIFFERENCE * factors[index]
        above = _residuals(flights, predict(factors + step, _launches(flights)), whiteners)
        below = _residuals(flights, predict(factors - step, _launches(flights)), whiteners)
        columns.append((above - below) / (2 * step[index]))
    return np.column_stack(columns)


def _by_common(
    flights: Sequence[MeasuredFlight],
    factors: Array,
    predict: _Predict,
    whiteners: Sequence[Array],
    calibration: FlightUncertainty,
) -> Array:
    """Return the whitened residuals' change for one standard uncertainty of each common error."""
    slopes = _by_launch(flights, factors, predict)
    of_launch = np.concatenate(
        [w @ slope * calibration.of_launch() for w, slope in zip(whiteners, slopes, strict=True)]
    )
    columns = [of_launch]
    for name in (*_FIGURES, "distance", "height"):
        parts = [w @ _share_of(f, name, calibration) for f, w in zip(flights, whiteners, strict=True)]
        columns.append(np.concatenate(parts)[:, None])
    return np.hstack(columns)


def _share_of(flight: MeasuredFlight, name: str, calibration: FlightUncertainty) -> Array:
    """Return the systematic error of one kind of observation; 0 if `flight` has no such observation."""
    kinds = [figure for figure in _FIGURES if getattr(flight, figure) is not None]
    if flight.points is not None:
        kinds += ["distance"] * len(flight.points) + ["height"] * len(flight.points)
    error = getattr(calibration, name, calibration.point)
    return np.array([error if kind == name else 0.0 for kind in kinds])
