"""Drag and lift of a ball model: two factors on published coefficients, and their fit to measured flights.

A flight has carry, apex and time, or points of the trajectory.

Weighted least squares for two factors on a published coefficient model. The launch is also measured: its
scatter moves carry, apex and time of a flight together, so each flight's residuals are whitened by the
covariance of launch and observation (errors in the variables, linearised). The covariance of the factors
follows from the whitened Jacobian, times chi square per degree of freedom where that exceeds 1 (Birge ratio);
what all flights have in common (calibration of the device) is added through the fit's own sensitivities.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field
from datetime import datetime
from math import cos, sin, sqrt
from typing import Annotated, Any, TypeAlias

import numpy as np
from scipy.optimize import least_squares

from bench.base.from_toml import checked_values
from drivers.base import Launch
from drivers.base.ranges import Range
from sim.air import Air
from sim.ball import Ball
from sim.flight import Aerodynamics, Wind, fly, fly_many
from sim.turf import Turf

BEYOND = 0.05
"""Share of speed and spin by which a launch may lie outside the measured range."""
_FACTOR_STEP = 0.005
"""Step of the factors for the derivatives of a carry."""

Factor = Annotated[float, Range(0.2, 3.0, "")]
FactorError = Annotated[float, Range(0.0, 1.0, "")]
Speed = Annotated[float, Range(0.0, 150.0, "m/s")]
Spin = Annotated[float, Range(0.0, 2000.0, "rad/s")]


@dataclass(frozen=True)
class BallAerodynamics:
    """Drag and lift of a ball model as factors on the coefficients of `model`, fitted to measured flights."""

    ball: str
    """Name of the ball model in plans."""
    mass: Annotated[float, Range(0.02, 0.06, "kg")]
    radius: Annotated[float, Range(0.015, 0.03, "m")]
    model: str
    """Name of a `sim.aerodynamics.Aerodynamics`."""
    drag_factor: Factor
    lift_factor: Factor
    drag_error: FactorError
    """Standard uncertainty of the drag factor."""
    lift_error: FactorError
    correlation: Annotated[float, Range(-1.0, 1.0, "")]
    """Correlation of the two errors."""
    flights: Annotated[int, Range(1, 1_000_000, "")]
    """Number of flights of the fit."""
    min_speed: Speed
    """Min ball speed of these flights, m/s."""
    max_speed: Speed
    min_spin: Spin
    """Min spin of these flights, rad/s."""
    max_spin: Spin
    chi_square: Annotated[float, Range(0.0, 1e9, "")]
    """Chi square of the fit per degree of freedom; 1 where the stated scatter holds."""

    def __post_init__(self) -> None:
        """Raise ValueError if the model is unknown."""
        if self.model not in Aerodynamics.__members__:
            raise ValueError(f"model: {self.model}, expected one of {', '.join(Aerodynamics.__members__)}")

    @property
    def as_flown(self) -> Ball:
        """The ball with these coefficients."""
        return self._with(self.drag_factor, self.lift_factor)

    @property
    def aerodynamics(self) -> Aerodynamics:
        """The coefficient model that the factors belong to."""
        return Aerodynamics[self.model]

    def outside(self, launch: Launch) -> str:
        """Return why `launch` lies outside the measured range; empty if it does not."""
        for name, value, low, high, unit, scale in (
            ("ball speed", launch.speed, self.min_speed, self.max_speed, "m/s", 1.0),
            ("spin", launch.spin, self.min_spin, self.max_spin, "rpm", 30.0 / np.pi),
        ):
            if not (1 - BEYOND) * low <= value <= (1 + BEYOND) * high:
                return (
                    f"{name} {scale * value:.1f} {unit}, aerodynamics of {self.ball} measured from "
                    f"{scale * low:.1f} to {scale * high:.1f} {unit}"
                )
        return ""

    def carry_error(self, launch: Launch, air: Air, wind: Wind, turf: Turf) -> float:
        """Return the standard uncertainty of a carry (m) from that of the two factors."""
        d, f, h = self.drag_factor, self.lift_factor, _FACTOR_STEP
        carries = [
            float(fly_many(np.array([launch]), air, ball, wind, turf, self.aerodynamics)["carry"][0])
            for ball in (
                self._with(d + h, f),
                self._with(d - h, f),
                self._with(d, f + h),
                self._with(d, f - h),
            )
        ]
        by_drag, by_lift = (carries[0] - carries[1]) / (2 * h), (carries[2] - carries[3]) / (2 * h)
        one, two = by_drag * self.drag_error, by_lift * self.lift_error
        return sqrt(max(one * one + two * two + 2 * self.correlation * one * two, 0.0))

    def _with(self, drag: float, lift: float) -> Ball:
        return Ball(self.ball, self.mass, self.radius, drag_factor=drag, lift_factor=lift)


@dataclass(frozen=True)
class AerodynamicsEntry:
    """One stored measurement of a ball model's aerodynamics."""

    version: int
    """Rises by one per bench and ball."""
    date: datetime
    source: str
    """Device and place that the flight data come from."""
    by: str
    values: BallAerodynamics

    @property
    def text(self) -> str:
        """Coefficients with uncertainty, source and date, for people."""
        v = self.values
        return (
            f"drag {v.drag_factor:.4f} ± {v.drag_error:.4f}, lift {v.lift_factor:.4f} ± {v.lift_error:.4f} "
            f"times {v.model} (standard errors, correlation {v.correlation:+.2f}), {v.flights} flights "
            f"at {v.min_speed:.1f} to {v.max_speed:.1f} m/s, chi square per degree of freedom "
            f"{v.chi_square:.2f}; {self.source}, {self.date:%Y-%m-%d}, version {self.version}, "
            f"by {self.by}"
        )

    def record(self) -> dict[str, Any]:
        """Return it as JSON values; `aerodynamics_from_record` reads them back."""
        return {
            "version": self.version,
            "date": self.date.isoformat(),
            "source": self.source,
            "by": self.by,
            "values": asdict(self.values),
        }


def aerodynamics_from_record(record: Mapping[str, Any], location: str) -> AerodynamicsEntry:
    """Return the measurement that `AerodynamicsEntry.record` gave. Raises as `checked_values`."""
    return AerodynamicsEntry(
        int(record["version"]),
        datetime.fromisoformat(record["date"]),
        str(record["source"]),
        str(record["by"]),
        checked_values(BallAerodynamics, record["values"], location),
    )


Array: TypeAlias = np.ndarray[Any, Any]

MIN_FLIGHTS = 3
_MODEL = Aerodynamics.LIBGOLF
"""Coefficients that the factors are fitted on."""
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
) -> BallAerodynamics:
    """Return drag and lift of `ball` (its `mass` kg, `radius` m) from its `flights`, at least three.

    `scatter` differs from flight to flight, `calibration` is common to all flights.

    Raises:
        ValueError: too few flights or observations, scatter of 0, or data that do not determine both factors.
    """
    dof = _dof(flights, scatter)

    def predict(factors: Array, launches: Sequence[Launch]) -> list[Array]:
        body = Ball(ball, mass, radius, drag_factor=float(factors[0]), lift_factor=float(factors[1]))
        return _predicted(flights, launches, body)

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
        model=_MODEL.name,
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


def _predicted(flights: Sequence[MeasuredFlight], launches: Sequence[Launch], ball: Ball) -> list[Array]:
    """Return for each flight what its `observed` would be for `ball`; one compiled loop for each air."""
    groups: dict[tuple[Air, tuple[float, float, float]], list[int]] = {}
    for number, flight in enumerate(flights):
        groups.setdefault((flight.air, flight.wind), []).append(number)
    predicted: list[Array] = [np.empty(0)] * len(flights)
    for (air, wind), members in groups.items():
        flown = np.array([launches[n] for n in members])
        rows = fly_many(flown, air, ball, Wind(wind), aerodynamics=_MODEL, step=_TIME_STEP)
        for row, n in zip(rows, members, strict=True):
            figures = [float(row[name]) for name in _FIGURES if getattr(flights[n], name) is not None]
            predicted[n] = np.concatenate([figures, _points(flights[n], launches[n], ball)])
    return predicted


def _points(flight: MeasuredFlight, launch: Launch, ball: Ball) -> Array:
    """Return distances and heights of the flight at the times of its measured points."""
    if flight.points is None:
        return np.empty(0)
    path = fly(launch, flight.air, ball, Wind(flight.wind), aerodynamics=_MODEL).path
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
