"""Drag and lift of a ball model: two factors on published coefficients, and their fit to measured flights.

A flight has carry, apex and time, or points of the trajectory.

Weighted least squares for two factors on a published coefficient model. The launch is also measured: its
scatter moves carry, apex and time of a flight together, so each flight's residuals are whitened by the
covariance of launch and observation (errors in the variables, linearised). The covariance of the factors
follows from the whitened Jacobian, times chi square per degree of freedom where that exceeds 1 (Birge ratio);
what all flights have in common (calibration of the device) is added through the fit's own sensitivities.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field, replace
from datetime import datetime
from math import cos, sin, sqrt
from typing import Annotated, Any, TypeAlias

import numpy as np

from bench.base.from_toml import checked_values
from drivers.base import Launch
from drivers.base.ranges import Range
from sim.ball import Air, Ball
from sim.flight import Aerodynamics, Wind, fly, fly_many
from sim.ground import Turf

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
    """Name of a `sim.flight.Aerodynamics`."""
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
    def subject(self) -> str:
        """Name of the ball."""
        return self.values.ball

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
_MIN_FACTOR, _MAX_FACTOR = 0.2, 2.9
"""Bounds of both factors in a fit; its difference quotients go beyond them, within the bounds of `Ball`."""
_DIFFERENCE = 1e-3
"""Relative step of the factors in derivatives."""
_LAUNCH_STEPS = {"speed": 0.05, "launch_angle": 0.001, "spin": 5.0}
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
    def kinds(self) -> list[str]:
        """Kind of each observation in `observed`."""
        figures = [name for name in _FIGURES if getattr(self, name) is not None]
        points = 0 if self.points is None else len(self.points)
        return [*figures, *["distance"] * points, *["height"] * points]

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
        return np.array([getattr(self, kind, self.point) for kind in flight.kinds])


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
    fit = _Fit(Ball(ball, mass, radius), flights)
    factors, cost, whiteners = fit.solved(scatter)
    chi_square = 2.0 * cost / dof
    covariance = fit.covariance(factors, whiteners, calibration, max(1.0, chi_square))
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


class _Fit:
    """Flights of a ball, and the prediction of their observations by its factors of drag and lift (2,)."""

    def __init__(self, ball: Ball, flights: Sequence[MeasuredFlight]) -> None:
        self._ball, self._flights = ball, flights

    def solved(self, scatter: FlightUncertainty) -> tuple[Array, float, list[Array]]:
        """Return the factors, half the sum of the squared whitened residuals, and the whitening matrices."""
        from scipy.optimize import least_squares  # here, as a running bench reads factors and fits none

        factors, cost, whiteners = np.array([1.0, 1.0]), 0.0, list[Array]()
        bounds, step = (_MIN_FACTOR, _MAX_FACTOR), [_DIFFERENCE] * 2
        for _ in range(_ROUNDS):
            whiteners = self._whiteners(factors, scatter)
            found = least_squares(self._residuals, factors, args=(whiteners,), bounds=bounds, diff_step=step)
            factors, cost = found.x, float(found.cost)
        if np.any((factors < 1.05 * _MIN_FACTOR) | (factors > _MAX_FACTOR / 1.05)):
            raise ValueError(
                f"drag factor {factors[0]:.3g}, lift factor {factors[1]:.3g} at their bounds "
                f"{_MIN_FACTOR:g} and {_MAX_FACTOR:g}; check units and columns of the flights"
            )
        return factors, cost, whiteners

    def covariance(
        self, factors: Array, whiteners: Sequence[Array], calibration: FlightUncertainty, widening: float
    ) -> Array:
        """Return the covariance of `factors`: scatter times `widening`, plus that of the calibration."""
        by_factor = self._by_factor(factors, whiteners)
        information = by_factor.T @ by_factor
        if np.linalg.cond(information) > 1e12:
            raise ValueError("the data do not separate drag from lift: add apex, time or points")
        inverse = np.linalg.inv(information)
        common = inverse @ by_factor.T @ self._by_common(factors, whiteners, calibration)
        total: Array = widening * inverse + common @ common.T
        return total

    def _predicted(self, factors: Array, figure: str = "", step: float = 0.0) -> list[Array]:
        """Return each flight's `observed` by `factors`, one compiled loop for each air.

        A `figure` of the launches is greater by `step`.
        """
        ball = replace(self._ball, drag_factor=float(factors[0]), lift_factor=float(factors[1]))
        launches = [flight.launch for flight in self._flights]
        if figure:
            launches = [one._replace(**{figure: getattr(one, figure) + step}) for one in launches]
        groups: dict[tuple[Air, tuple[float, float, float]], list[int]] = {}
        for number, flight in enumerate(self._flights):
            groups.setdefault((flight.air, flight.wind), []).append(number)
        predicted: list[Array] = [np.empty(0)] * len(launches)
        for (air, wind), members in groups.items():
            flown = np.array([launches[n] for n in members])
            rows = fly_many(flown, air, ball, Wind(wind), aerodynamics=_MODEL, step=_TIME_STEP)
            for row, n in zip(rows, members, strict=True):
                figures = [float(row[name]) for name in self._flights[n].kinds if name in _FIGURES]
                predicted[n] = np.concatenate([figures, _points(self._flights[n], launches[n], ball)])
        return predicted

    def _residuals(self, factors: Array, whiteners: Sequence[Array]) -> Array:
        rows = zip(self._flights, self._predicted(factors), whiteners, strict=True)
        return np.concatenate([w @ (p - f.observed) for f, p, w in rows])

    def _by_launch(self, factors: Array) -> list[Array]:
        """Return the derivatives of each flight's observations by speed, launch angle and spin."""
        columns = []
        for figure, step in _LAUNCH_STEPS.items():
            above, below = (self._predicted(factors, figure, way) for way in (step, -step))
            columns.append([(a - b) / (2 * step) for a, b in zip(above, below, strict=True)])
        return [np.column_stack(three) for three in zip(*columns, strict=True)]

    def _whiteners(self, factors: Array, scatter: FlightUncertainty) -> list[Array]:
        """Return for each flight the matrix that makes its residuals independent with a deviation of 1."""
        found = []
        for flight, slope in zip(self._flights, self._by_launch(factors), strict=True):
            of_launch = slope * scatter.of_launch()
            covariance = of_launch @ of_launch.T + np.diag(scatter.of_observations(flight) ** 2)
            found.append(np.linalg.inv(np.linalg.cholesky(covariance)))
        return found

    def _by_factor(self, factors: Array, whiteners: Sequence[Array]) -> Array:
        """Return the derivatives of the whitened residuals with respect to the two factors."""
        columns = []
        for index in range(2):
            step = np.zeros(2)
            step[index] = _DIFFERENCE * factors[index]
            above, below = (self._residuals(factors + way, whiteners) for way in (step, -step))
            columns.append((above - below) / (2 * step[index]))
        return np.column_stack(columns)

    def _by_common(self, factors: Array, whiteners: Sequence[Array], calibration: FlightUncertainty) -> Array:
        """Return the whitened residuals' change for one standard uncertainty of each common error."""
        slopes = zip(whiteners, self._by_launch(factors), strict=True)
        columns = [np.concatenate([w @ slope * calibration.of_launch() for w, slope in slopes])]
        for name in (*_FIGURES, "distance", "height"):
            error = getattr(calibration, name, calibration.point)
            parts = [
                w @ np.array([error if kind == name else 0.0 for kind in flight.kinds])
                for flight, w in zip(self._flights, whiteners, strict=True)
            ]
            columns.append(np.concatenate(parts)[:, None])
        return np.hstack(columns)


def _points(flight: MeasuredFlight, launch: Launch, ball: Ball) -> Array:
    """Return distances and heights of the flight at the times of its measured points."""
    if flight.points is None:
        return np.empty(0)
    path = fly(launch, flight.air, ball, Wind(flight.wind), aerodynamics=_MODEL).path
    along = path[:, 1] * cos(launch.direction) + path[:, 3] * sin(launch.direction)
    times = flight.points[:, 0]
    return np.concatenate([np.interp(times, path[:, 0], along), np.interp(times, path[:, 0], path[:, 2])])
