"""The flight of a golf ball, from its launch to rest.

Golf frame: X along the target line, Y up, Z to the right of it. Equations (Smits and Smith 1994):
    dv/dt = (rho A / 2 m) V [-Cd v + Cl (s x v)] - g,   d omega/dt = -2e-5 omega V / r,
v relative to the air, V = |v|, s the spin's axis, which keeps its direction. Drag and lift coefficients
are published functions of Re = 2 r V / nu and S = r omega / V, refer to the ball's cross-section, and were
not fitted by this project. Air comes from `sim.ball`, bounce and roll from `sim.ground`. RK4 with a fixed
step; apex and landing are found inside their step, so that they too converge.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from math import atan2, cos, hypot, isfinite, pi, sin
from typing import Annotated, Any, NamedTuple, TypeAlias

import numpy as np

from drivers.base import Launch
from drivers.base.compiled import compiled, compiled_with_arrays, fields, new_record
from drivers.base.ranges import Range, check_ranges
from sim.ball import Air, Ball
from sim.ground import Turf, bounce, roll
from sim.vectors import Vector, across_flight, added, norm, scaled, unit

Array: TypeAlias = np.ndarray[Any, Any]

GRAVITY = 9.80665
STEP = 0.005
"""Integration step (s); a tenfold finer one changes a carry by millimetres (tests)."""

_MAX_FLIGHT_TIME = 60.0
_MAX_BOUNCES = 25
_MIN_BOUNCE_SPEED = 0.3  # m/s upwards: below this the ball rolls


# Coefficients -----------------------------------------------------------------------------------------


class Aerodynamics(IntEnum):
    """Coefficient models; compiled code gets the number."""

    LIBGOLF = 0
    """libgolf's default: `include/DefaultAerodynamicModel.hpp` and `docs/aerodynamic_model.md` of
    github.com/gdifiore/libgolf, commit 1094535 (after Lyu, Washington State University 2018, and Bearman
    and Harvey 1976). Our own implementation of its equations. Any Re and S."""
    SMITS_SMITH = 1
    """Smits and Smith 1994 (Science and Golf II), as printed in patent US 11230375. Measured for
    70e3 < Re < 210e3 and 0.08 < S < 0.2; Re is held at the ends of that range."""


SPIN_DECAY = 2.0e-5
"""d omega/dt = -SPIN_DECAY omega V / r (Smits and Smith 1994; libgolf uses the same)."""


@compiled
def coefficients(model: int, reynolds: float, spin_ratio: float) -> tuple[float, float]:
    """Return (drag, lift) coefficient of `model` (an `Aerodynamics` number)."""
    if model == 1:
        return _smits_smith(reynolds, spin_ratio)
    return _libgolf(reynolds, spin_ratio)


@compiled
def _libgolf(reynolds: float, S: float) -> tuple[float, float]:
    re = reynolds * 1e-5
    drag = 0.5 - 0.3 * min(max((re - 0.5) / 0.5, 0.0), 1.0) + 0.18 * S  # a linear drag crisis
    ceiling = 0.268 + 0.052 * min(max((S - 0.35) / 0.15, 0.0), 1.0)
    if S <= 0.0 or re <= 0.3:
        return drag, 0.0
    if re < 0.5:
        x = (re - 0.3) / 0.2
        lift = _lift_at_50000(S) * x * x * (3.0 - 2.0 * x)
    elif re < 0.6:
        lift = _between(re, 0.5, _lift_at_50000(S), 0.6, _lift_at_60000(S))
    elif re < 0.65:
        lift = _between(re, 0.6, _lift_at_60000(S), 0.65, _lift_at_65000(S))
    elif re < 0.7:
        lift = _between(re, 0.65, _lift_at_65000(S), 0.7, _lift_at_70000(S))
    else:
        lift = ceiling * 16.0 * S / (1.0 + 16.0 * S)  # saturating; steps at Re = 70,000 as published
    return drag, min(max(lift, 0.0), ceiling)


@compiled
def _between(x: float, x0: float, y0: float, x1: float, y1: float) -> float:
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)


@compiled
def _lift_at_50000(S: float) -> float:
    return 0.0472121 + S * (2.84795 + S * (-23.4342 + S * 45.4849))


@compiled
def _lift_at_60000(S: float) -> float:
    return 0.320524 + S * (-4.7032 + S * 14.0613)


@compiled
def _lift_at_65000(S: float) -> float:
    return 0.266667 + S * (-4.0 + S * 13.3333)


@compiled
def _lift_at_70000(S: float) -> float:
    return 0.0496189 + S * (0.00211396 + S * 2.34201)


@compiled
def _smits_smith(reynolds: float, S: float) -> tuple[float, float]:
    re = min(max(reynolds, 70e3), 210e3)
    drag = 0.24 + 0.18 * S + 0.06 * sin(pi * (re - 90e3) / 200e3)
    return drag, 0.54 * max(S, 0.0) ** 0.4


# Flight -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Wind:
    """Wind: `velocity` (x, y, z) m/s in the golf frame at `reference_height` (m).

    Elsewhere it is that times (height / reference height) ** `exponent`: 0 is the same wind at all heights,
    1/7 the usual power law over open ground. A value outside its physical range raises ValueError.
    """

    velocity: Vector = (0.0, 0.0, 0.0)
    """Velocity along the target line, up, to the right (m/s)."""
    reference_height: Annotated[float, Range(0.1, 1000.0, "m")] = 10.0
    """Height at which that blows (m)."""
    exponent: Annotated[float, Range(0.0, 1.0, "")] = 0.0
    """Exponent of the height: 0 the same everywhere, 1/7 over open ground."""

    def __post_init__(self) -> None:
        check_ranges(self)
        if np.shape(self.velocity) != (3,) or not np.all(np.abs(self.velocity) <= 60.0):
            raise ValueError(f"Wind.velocity: found {self.velocity!r}, expected 3 values, -60 to 60 m/s")


FLIGHT = np.dtype(
    [
        *fields("f8", "carry carry_side total total_side apex"),
        *fields("f8", "landing_angle landing_speed landing_spin time total_time"),
    ],
    align=True,
)
"""Record of `fly_many` for each launch; names and units as in `Flight`."""


class _Settings(NamedTuple):
    """Parameters of a flight except its launch, for compiled code."""

    model: int
    lift_and_drag: float
    """rho A / 2 m"""
    reynolds: float
    """Reynolds number at 1 m/s"""
    radius: float
    drag_factor: float
    lift_factor: float
    wind: Vector
    wind_height: float
    wind_exponent: float
    turf_friction: float
    turf_tilt: float
    turf_restitution: float
    turf_resistance: float
    step: float


@dataclass(frozen=True)
class Flight:
    """A flight: distances in m, angles in rad, times in s, spin in rad/s.

    Carry ends where the ball comes down to the height of the ground at its start (0); `carry` and
    `total` are straight horizontal distances from the start, `carry_side` and `total_side` their offline
    parts, positive to the right. `landing_angle` is positive downwards. `time` ends with the carry,
    `total_time` at rest. `path` has a row (t, x, y, z) for each step down to rest.
    """

    carry: float
    carry_side: float
    total: float
    total_side: float
    apex: float
    landing_angle: float
    landing_speed: float
    landing_spin: float
    time: float
    total_time: float
    path: Array = field(repr=False, compare=False)
    aerodynamics: str = Aerodynamics.LIBGOLF.name
    turf: str = "fairway (Penner 2002)"


def fly(
    launch: Launch,
    air: Air | None = None,
    ball: Ball | None = None,
    wind: Wind | Vector | None = None,
    turf: Turf | None = None,
    aerodynamics: Aerodynamics = Aerodynamics.LIBGOLF,
    step: float = STEP,
) -> Flight:
    """Return the flight of a ball with `launch`.

    `air` defaults to 25 degrees C at sea level, `wind` to none (a tuple is its velocity in the golf frame,
    m/s), `turf` to a fairway. `step` is in s.
    Raises ValueError for a launch or setting outside its physical range, and for a ball that stays up 60 s.
    """
    ball, turf = ball or Ball(), turf or Turf()
    settings = _settings(air or Air(), ball, wind, turf, aerodynamics, step)
    launches = _checked(np.array([launch], dtype=float))
    result = new_record(FLIGHT)
    path = np.empty((int(2 * _MAX_FLIGHT_TIME / step) + 4 * _MAX_BOUNCES, 4))
    rows = _fly(launches[0], settings, result, path)
    if not isfinite(result["carry"][0]):
        raise ValueError(f"the ball is still in the air after {_MAX_FLIGHT_TIME:g} s; check wind and factors")
    values = {name: float(result[name][0]) for name in FLIGHT.names or ()}
    surface = f"{turf.name} ({turf.model})"
    return Flight(**values, path=path[:rows].copy(), aerodynamics=aerodynamics.name, turf=surface)


def fly_many(
    launches: Array,
    air: Air | None = None,
    ball: Ball | None = None,
    wind: Wind | Vector | None = None,
    turf: Turf | None = None,
    aerodynamics: Aerodynamics = Aerodynamics.LIBGOLF,
    step: float = STEP,
) -> Array:
    """Return the flights of `launches`, shape (n, 5) in the order of `Launch`, as n records of `FLIGHT`.

    Same arguments, figures and errors as `fly`, without paths, in one compiled loop; a ball still in the air
    after 60 s gives NaN.
    """
    settings = _settings(air or Air(), ball or Ball(), wind, turf or Turf(), aerodynamics, step)
    launches = _checked(np.ascontiguousarray(launches, dtype=float))
    results = new_record(FLIGHT, len(launches))
    _fly_all(launches, settings, results)
    return results


_LAUNCH_RANGES = (
    ("speed", 0.0, 150.0, "m/s"),
    ("launch_angle", -pi / 2, pi / 2, "rad"),
    ("direction", -pi, pi, "rad"),
    ("spin", 0.0, 2000.0, "rad/s"),
    ("spin_axis", -pi, pi, "rad"),
)


def _checked(launches: Array) -> Array:
    if launches.ndim != 2 or launches.shape[1] != len(_LAUNCH_RANGES):
        raise ValueError(f"launches: found shape {launches.shape}, expected (n, 5) in the order of Launch")
    for column, (name, low, high, units) in enumerate(_LAUNCH_RANGES):
        values = launches[:, column]
        bad = ~((values >= low) & (values <= high))  # NaN is bad too
        if bad.any():
            row = int(np.argmax(bad))
            found = float(values[row])
            raise ValueError(
                f"launch {row}, {name}: found {found!r}, expected {low:.4g} to {high:.4g} {units}"
            )
    return launches


def _settings(
    air: Air, ball: Ball, wind: Wind | Vector | None, turf: Turf, aerodynamics: Aerodynamics, step: float
) -> _Settings:
    if not 1e-5 <= step <= 0.05:
        raise ValueError(f"step: found {step!r} s, expected 0.00001 to 0.05 s")
    if not isinstance(wind, Wind):
        wind = Wind() if wind is None else Wind(wind)
    return _Settings(
        model=int(aerodynamics),
        lift_and_drag=air.density * pi * ball.radius**2 / (2.0 * ball.mass),
        reynolds=2.0 * ball.radius * air.density / air.viscosity,
        radius=float(ball.radius),
        drag_factor=float(ball.drag_factor),
        lift_factor=float(ball.lift_factor),
        wind=(float(wind.velocity[0]), float(wind.velocity[1]), float(wind.velocity[2])),
        wind_height=float(wind.reference_height),
        wind_exponent=float(wind.exponent),
        turf_friction=float(turf.friction),
        turf_tilt=float(turf.tilt),
        turf_restitution=float(turf.restitution_factor),
        turf_resistance=float(turf.rolling_resistance),
        step=float(step),
    )


State = tuple[float, float, float, float, float, float, float]
"""(x, y, z, vx, vy, vz, omega) of the ball; the spin's axis is constant in the air and passed separately."""


@compiled
def _derivative(state: State, axis: Vector, settings: _Settings) -> State:
    s = settings
    gain = 1.0
    if s.wind_exponent > 0.0:
        gain = (max(state[1], 0.0) / s.wind_height) ** s.wind_exponent
    vx, vy, vz = added((state[3], state[4], state[5]), -gain, s.wind)
    omega = state[6]
    V = norm((vx, vy, vz))
    if V < 1e-9:
        return (state[3], state[4], state[5], 0.0, -GRAVITY, 0.0, 0.0)
    drag, lift = coefficients(s.model, s.reynolds * V, s.radius * omega / V)
    k = s.lift_and_drag * V
    d = k * drag * s.drag_factor
    f = k * lift * s.lift_factor
    return (
        state[3],
        state[4],
        state[5],
        -d * vx + f * (axis[1] * vz - axis[2] * vy),
        -d * vy + f * (axis[2] * vx - axis[0] * vz) - GRAVITY,
        -d * vz + f * (axis[0] * vy - axis[1] * vx),
        -SPIN_DECAY * omega * V / s.radius,
    )


@compiled
def _shifted(a: State, h: float, b: State) -> State:
    return (
        a[0] + h * b[0],
        a[1] + h * b[1],
        a[2] + h * b[2],
        a[3] + h * b[3],
        a[4] + h * b[4],
        a[5] + h * b[5],
        a[6] + h * b[6],
    )


@compiled
def _advanced(state: State, axis: Vector, h: float, settings: _Settings) -> State:
    """One RK4 step of h seconds."""
    k1 = _derivative(state, axis, settings)
    k2 = _derivative(_shifted(state, h / 2.0, k1), axis, settings)
    k3 = _derivative(_shifted(state, h / 2.0, k2), axis, settings)
    k4 = _derivative(_shifted(state, h, k3), axis, settings)
    state = _shifted(state, h / 6.0, k1)
    state = _shifted(state, h / 3.0, k2)
    state = _shifted(state, h / 3.0, k3)
    return _shifted(state, h / 6.0, k4)


@compiled
def _event_time(state: State, axis: Vector, h: float, settings: _Settings, index: int) -> float:
    """Time within a step of h at which state[index] falls through zero (bisection and secant, guarded)."""
    low, high = 0.0, h
    f_low = state[index]
    f_high = _advanced(state, axis, h, settings)[index]
    t = h
    for _ in range(60):
        t = low + (high - low) * min(max(f_low / (f_low - f_high), 0.02), 0.98)
        f = _advanced(state, axis, t, settings)[index]
        if f > 0.0:
            low, f_low = t, f
        else:
            high, f_high = t, f
        if high - low < 1e-9 or abs(f) < 1e-12:
            break
    return t


@compiled
def _recorded(path: Array, row: int, t: float, x: float, y: float, z: float) -> int:
    """Write (t, x, y, z) where the path has room; return the next row."""
    if row >= path.shape[0]:
        return row
    path[row, 0], path[row, 1], path[row, 2], path[row, 3] = t, x, y, z
    return row + 1


@compiled
def _airborne(
    state: State, axis: Vector, t: float, settings: _Settings, path: Array, row: int
) -> tuple[State, float, float, int]:
    """Fly until the ball falls to height 0 (or the time limit); return state, time, apex and path row."""
    h = settings.step
    apex = state[1]
    while t < _MAX_FLIGHT_TIME:
        following = _advanced(state, axis, h, settings)
        if state[4] > 0.0 and following[4] <= 0.0:
            apex = max(apex, _advanced(state, axis, _event_time(state, axis, h, settings, 4), settings)[1])
        if following[1] <= 0.0 and following[4] < 0.0:
            rise = 0.0
            if state[1] <= 0.0:  # up and down again within this one step
                rise = _event_time(state, axis, h, settings, 4)
                state = _advanced(state, axis, rise, settings)
            fall = _event_time(state, axis, h - rise, settings, 1)
            state = _advanced(state, axis, fall, settings)
            t += rise + fall
            state = (state[0], 0.0, state[2], state[3], state[4], state[5], state[6])
            return state, t, apex, _recorded(path, row, t, state[0], state[1], state[2])
        state = following
        t += h
        row = _recorded(path, row, t, state[0], state[1], state[2])
    return state, t, apex, row


@compiled
def _fly(launch: Array, settings: _Settings, result: Array, path: Array) -> int:
    """Fill result[0] (`FLIGHT`) and `path` for launch (5,); return the number of path rows."""
    s, r = settings, result[0]
    speed, elevation, azimuth, omega, tilt = launch[0], launch[1], launch[2], launch[3], launch[4]
    axis = _spin_axis(elevation, azimuth, tilt)
    vx, vy = speed * cos(elevation) * cos(azimuth), speed * sin(elevation)
    state = (0.0, 0.0, 0.0, vx, vy, speed * cos(elevation) * sin(azimuth), omega)
    t = 0.0
    row = _recorded(path, 0, t, state[0], state[1], state[2])
    r.apex = 0.0
    if state[4] > 0.0:
        state, t, r.apex, row = _airborne(state, axis, t, settings, path, row)
    if t >= _MAX_FLIGHT_TIME:
        r.carry = r.carry_side = r.total = r.total_side = r.apex = r.time = r.total_time = np.nan
        r.landing_angle = r.landing_speed = r.landing_spin = np.nan
        return row
    r.carry = hypot(state[0], state[2])
    r.carry_side = state[2]
    r.landing_angle = atan2(-state[4], hypot(state[3], state[5]))
    r.landing_speed = norm((state[3], state[4], state[5]))
    r.landing_spin = state[6]
    r.time = t

    velocity = (state[3], state[4], state[5])
    spin = scaled(state[6], axis)
    for _ in range(_MAX_BOUNCES):
        if velocity[1] < 0.0:
            velocity, spin = bounce(
                velocity, spin, s.radius, s.turf_friction, s.turf_tilt, s.turf_restitution
            )
        if velocity[1] < _MIN_BOUNCE_SPEED:
            break
        axis = unit(spin)
        state = (state[0], 0.0, state[2], velocity[0], velocity[1], velocity[2], norm(spin))
        state, t, _, row = _airborne(state, axis, t, settings, path, row)
        velocity = (state[3], state[4], state[5])
        spin = scaled(state[6], axis)
    run_x, run_z, duration = roll(velocity, spin, s.radius, s.turf_resistance, GRAVITY)
    row = _roll_recorded(path, row, t, state, run_x, run_z, duration)
    r.total = hypot(state[0] + run_x, state[2] + run_z)
    r.total_side = state[2] + run_z
    r.total_time = t + duration
    return row


@compiled
def _roll_recorded(
    path: Array, row: int, t: float, state: State, run_x: float, run_z: float, duration: float
) -> int:
    """Record a uniformly decelerated roll in 20 rows."""
    for i in range(1, 21):
        share = 1.0 - (1.0 - i / 20.0) ** 2
        x, z = state[0] + share * run_x, state[2] + share * run_z
        row = _recorded(path, row, t + duration * i / 20.0, x, 0.0, z)
    return row


@compiled
def _spin_axis(elevation: float, azimuth: float, tilt: float) -> Vector:
    """Unit spin axis: pure back spin at zero tilt, at right angles to the launch direction.

    A positive tilt lowers the axis' right end, which bends the flight to the right.
    """
    right, up = across_flight(elevation, azimuth)
    return added(scaled(cos(tilt), right), -sin(tilt), up)


@compiled_with_arrays
def _fly_all(launches: Array, settings: _Settings, results: Array) -> None:
    no_path = np.empty((0, 4))
    for i in range(launches.shape[0]):
        _fly(launches[i], settings, results[i : i + 1], no_path)
