"""The software plant: robot, air, friction, stops, encoders, ground, tee and ball in one compiled step.

One call of `advance` moves the plant over one tick with a constant command. Inside, fixed substeps:
the spools by their exact solution, dry friction as bounded impulses in halves around each step
(`sim.friction`), everything else by Runge-Kutta of fourth order; the impact is found inside the
substep by root finding and applies one and the same impulse to ball and robot (`sim.impact`).
Identical inputs and seeds give identical bits.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import cos, floor, log, pi, sin, sqrt
from typing import Annotated, Any

import numpy as np

from sim.ball import Ball
from sim.compiled import compiled, new_record
from sim.friction import friction_impulse
from sim.impact import face_gap, impact_in_plane, impact_parameters
from sim.kane import kane_terms, solve_symmetric
from sim.pneumatics import Actuator, EndStop, Friction, Supply, flow, friction_bound, stop_force
from sim.ranges import Range
from sim.robot import Club, Length, RobotParameters

HISTORY = 64
"""Substeps of joint angles kept for the encoders' latency."""


@dataclass(frozen=True)
class Encoders:
    """Three absolute single-turn rotary encoders on R1, R2, R3."""

    counts_per_revolution: Annotated[int, Range(256, 2**24, "counts")] = 2**17
    latency: Annotated[float, Range(0.0, 0.005, "s")] = 0.0001
    """From the shaft's position to the reading, s."""
    jitter: Annotated[float, Range(0.0, 0.001, "s")] = 0.0
    """Standard deviation of the sampling instant, s."""
    noise: Annotated[float, Range(0.0, 0.1, "rad")] = 0.0
    """Standard deviation, rad."""


@dataclass(frozen=True)
class Shaft:
    """In-plane bending of the shaft: the head's mass on a spring across the shaft line."""

    flexible: bool = False
    frequency: Annotated[float, Range(0.5, 100.0, "Hz")] = 4.5
    """First clamped mode with the head, Hz."""
    damping_ratio: Annotated[float, Range(0.0, 1.0, "")] = 0.03


@dataclass(frozen=True)
class Site:
    """Where ground and ball lie in the swing plane (m)."""

    ground: Annotated[float, Range(-3.0, 0.0, "m")] = -1.62
    """y0 of the ground line."""
    sole_depth: Annotated[float, Range(0.0, 0.2, "m")] = 0.03
    """How far the head reaches below its face centre (m)."""
    ball_x: Annotated[float, Range(-1.5, 1.5, "m")] = 0.25
    ball_y: Annotated[float, Range(-3.0, 0.0, "m")] = -1.56
    """Centre of the ball on its tee."""
    ground_stiffness: Annotated[float, Range(1e3, 1e8, "N/m")] = 2.0e5
    """N/m."""


def _shoulder() -> Actuator:
    return Actuator(
        area_a=4.0e-4,
        area_b=4.0e-4,
        dead_volume=6.0e-5,
        lower=-1.7,
        upper=2.7,
        friction=Friction(viscous=0.3, coulomb=6.0, static=8.0),
        stop=EndStop(energy=60.0, travel=0.10),
    )


def _right_arm() -> Actuator:
    return Actuator(
        area_a=19.63e-4,
        area_b=16.49e-4,
        dead_volume=3.0e-5,
        lower=0.0,
        upper=0.22,
        friction=Friction(viscous=30.0, coulomb=60.0, static=80.0),
        stop=EndStop(energy=30.0, travel=0.012, damping_speed=0.5),
    )


def _wrist() -> Actuator:
    return Actuator(
        area_a=19.63e-4,
        area_b=16.49e-4,
        dead_volume=3.0e-5,
        lower=2 * pi - np.deg2rad(80.0).item(),
        upper=2 * pi,
        friction=Friction(viscous=20.0, coulomb=45.0, static=60.0),
        stop=EndStop(energy=40.0, travel=0.12, damping_speed=4.0),
    )


@dataclass(frozen=True)
class PlantParameters:
    """Everything the plant needs; the defaults are the default plant, assumptions marked in config.toml."""

    robot: RobotParameters = field(default_factory=RobotParameters)
    shoulder: Actuator = field(default_factory=_shoulder)
    right_arm: Actuator = field(default_factory=_right_arm)
    wrist: Actuator = field(default_factory=_wrist)
    wrist_lever: Length = 0.06
    supply: Supply = field(default_factory=Supply)
    encoders: Encoders = field(default_factory=Encoders)
    shaft: Shaft = field(default_factory=Shaft)
    site: Site = field(default_factory=Site)
    ball: Ball = field(default_factory=Ball)
    tick: Annotated[float, Range(1e-4, 0.02, "s")] = 0.001
    """Time between two commands, s."""
    substeps: Annotated[int, Range(1, 256, "")] = 4
    seed: Annotated[int, Range(0, 2**63 - 1, "")] = 1

    @property
    def actuators(self) -> tuple[Actuator, Actuator, Actuator]:
        """The three actuators in the order of drivers.base.ACTUATORS."""
        return self.shoulder, self.right_arm, self.wrist


PLANT_PARAMETERS = np.dtype(
    [
        ("area_a", "f8", (3,)),
        ("area_b", "f8", (3,)),
        ("dead_volume", "f8", (3,)),
        ("lower", "f8", (3,)),
        ("upper", "f8", (3,)),
        ("volume_lower", "f8", (3,)),
        ("volume_upper", "f8", (3,)),
        ("viscous", "f8", (3,)),
        ("coulomb", "f8", (3,)),
        ("static", "f8", (3,)),
        ("stribeck_speed", "f8", (3,)),
        ("stop_stiffness", "f8", (3,)),
        ("stop_travel", "f8", (3,)),
        ("stop_damping_speed", "f8", (3,)),
        ("conductance", "f8", (3,)),
        ("critical_ratio", "f8", (3,)),
        ("dead_band", "f8", (3,)),
        ("leakage", "f8", (3,)),
        ("cross_leakage", "f8", (3,)),
        ("spool", "f8", (3, 4)),
        ("wrist_lever", "f8"),
        ("regulated", "f8"),
        ("feed_conductance", "f8"),
        ("manifold", "f8"),
        ("dump_conductance", "f8"),
        ("soft_start_time", "f8"),
        ("vent_conductance", "f8"),
        ("vent_delay", "f8"),
        ("atmosphere", "f8"),
        ("exponent", "f8"),
        ("encoder_scale", "f8"),
        ("encoder_counts", "i8"),
        ("latency", "f8"),
        ("jitter", "f8"),
        ("noise", "f8"),
        ("flexible", "?"),
        ("head_mass", "f8"),
        ("head_stiffness", "f8"),
        ("head_damping", "f8"),
        ("head_distance", "f8"),
        ("ground", "f8"),
        ("ground_stiffness", "f8"),
        ("sole_depth", "f8"),
        ("ball_x", "f8"),
        ("ball_y", "f8"),
        ("lie", "f8"),
        ("tick", "f8"),
        ("substeps", "i8"),
    ],
    align=True,
)

PLANT_STATE = np.dtype(
    [
        ("time", "f8"),
        ("angle", "f8", (3,)),
        ("speed", "f8", (3,)),
        ("pressure", "f8", (6,)),
        ("supply_pressure", "f8"),
        ("flex", "f8"),
        ("flex_speed", "f8"),
        ("spool", "f8", (3,)),
        ("spool_speed", "f8", (3,)),
        ("supply_level", "f8"),
        ("vent_timer", "f8"),
        ("effort", "f8", (3,)),
        ("head", "f8", (6,)),
        ("stop_work", "f8", (3,)),
        ("stop_energy", "f8", (3, 2)),
        ("stop_depth", "f8", (3, 2)),
        ("peak_pressure", "f8", (6,)),
        ("lowest_clearance", "f8"),
        ("peak_head_speed", "f8"),
        ("air_used", "f8"),
        ("emergency_stop_clear", "?"),
        ("guard_closed", "?"),
        ("guard_locked", "?"),
        ("local_reset", "?"),
        ("encoder_valid", "u1", (3,)),
        ("ball_present", "?"),
        ("tee_before", "?"),
        ("struck", "?"),
        ("impact_time", "f8"),
        ("impact_head", "f8", (6,)),
        ("impulse", "f8", (3,)),
        ("ball_velocity", "f8", (3,)),
        ("ball_spin", "f8", (3,)),
        ("history", "f8", (HISTORY, 3)),
        ("history_index", "i8"),
        ("random", "u8"),
    ],
    align=True,
)

Head = tuple[float, float, float, float, float, float]
_STATES = 15  # angles, speeds, six pressures, manifold, flex, flex speed


@dataclass(frozen=True)
class Plant:
    """The plant's parameters as records, made once; pass `records` to the compiled functions."""

    parameters: PlantParameters
    robot: np.ndarray
    plant: np.ndarray
    impact: np.ndarray

    @property
    def records(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(robot, plant, impact) in the order the compiled functions take them."""
        return self.robot, self.plant, self.impact


def _without_head(club: Club) -> Club:
    """Return the club whose head's mass is taken out of body C (it rides on the shaft's spring)."""
    return replace(club, head_mass=1e-9)


def build_plant(parameters: PlantParameters) -> Plant:
    """Turn `parameters` into the records of compiled code."""
    record = new_record(PLANT_PARAMETERS)
    club, robot = parameters.robot.club, parameters.robot
    half_step = parameters.tick / parameters.substeps / 2
    for i, actuator in enumerate(parameters.actuators):
        friction, stop, valve = actuator.friction, actuator.stop, actuator.valve
        values = {
            "area_a": actuator.area_a,
            "area_b": actuator.area_b,
            "dead_volume": actuator.dead_volume,
            "lower": actuator.lower,
            "upper": actuator.upper,
            "volume_lower": actuator.lower - stop.travel,
            "volume_upper": actuator.upper + stop.travel,
            "viscous": friction.viscous,
            "coulomb": friction.coulomb,
            "static": friction.static,
            "stribeck_speed": friction.stribeck_speed,
            "stop_stiffness": stop.stiffness,
            "stop_travel": stop.travel,
            "stop_damping_speed": stop.damping_speed,
            "conductance": valve.conductance,
            "critical_ratio": valve.critical_ratio,
            "dead_band": valve.dead_band,
            "leakage": valve.leakage,
            "cross_leakage": actuator.cross_leakage,
            "spool": valve.half_step_matrix(half_step).ravel(),
        }
        for name, value in values.items():
            record[name][0, i] = value
    # The wrist's cylinder coordinate is -lever cos(beta), beta = theta3 - 3 pi / 2.
    for name in ("volume_lower", "volume_upper"):
        record[name][0, 2] = -parameters.wrist_lever * cos(record[name][0, 2] - 1.5 * pi)
    supply, encoders, site, shaft = parameters.supply, parameters.encoders, parameters.site, parameters.shaft
    omega = 2 * pi * shaft.frequency
    scalars: dict[str, float] = {
        "wrist_lever": parameters.wrist_lever,
        "regulated": supply.pressure,
        "feed_conductance": supply.feed_conductance,
        "manifold": supply.volume,
        "dump_conductance": supply.dump_conductance,
        "soft_start_time": supply.soft_start_time,
        "vent_conductance": supply.vent_conductance,
        "vent_delay": supply.vent_delay,
        "atmosphere": supply.atmosphere,
        "exponent": supply.polytropic_exponent,
        "encoder_scale": encoders.counts_per_revolution / (2 * pi),
        "encoder_counts": encoders.counts_per_revolution,
        "latency": encoders.latency,
        "jitter": encoders.jitter,
        "noise": encoders.noise,
        "flexible": shaft.flexible,
        "head_mass": club.head_mass,
        "head_stiffness": club.head_mass * omega**2,
        "head_damping": 2 * shaft.damping_ratio * omega * club.head_mass,
        "head_distance": club.shaft_length,
        "ground": site.ground,
        "ground_stiffness": site.ground_stiffness,
        "sole_depth": site.sole_depth,
        "ball_x": site.ball_x,
        "ball_y": site.ball_y,
        "lie": robot.lie,
        "tick": parameters.tick,
        "substeps": parameters.substeps,
    }
    for name, value in scalars.items():
        record[name] = value
    rigid = replace(robot, club=_without_head(club)) if shaft.flexible else robot
    return Plant(parameters, rigid.record, record, impact_parameters(club, parameters.ball, robot.lie))


def initial_state(plant: Plant, angle: np.ndarray, *, pressurised: bool = False) -> np.ndarray:
    """Return a `PLANT_STATE` array at rest at `angle` (3,) rad, chambers at atmosphere or half the supply."""
    state = new_record(PLANT_STATE)
    supply = plant.parameters.supply
    state["angle"] = angle
    state["pressure"] = (supply.pressure + supply.atmosphere) / 2 if pressurised else supply.atmosphere
    state["supply_pressure"] = supply.pressure if pressurised else supply.atmosphere
    state["supply_level"] = 1.0 if pressurised else 0.0
    state["emergency_stop_clear"] = state["guard_closed"] = state["guard_locked"] = True
    state["encoder_valid"] = 1
    state["history"] = angle
    state["lowest_clearance"] = np.inf
    state["peak_pressure"] = state["pressure"]
    state["random"] = np.uint64(plant.parameters.seed)
    return state


@compiled
def wrist_stroke(p: Any, q3: float) -> tuple[float, float]:
    """Return cylinder coordinate (m) and lever d stroke/d theta3 (m) of the wrist; thesis Figure 11."""
    return -p.wrist_lever * cos(q3 - 1.5 * pi), p.wrist_lever * sin(q3 - 1.5 * pi)


@compiled
def _stop(p: Any, i: int, position: float, speed: float) -> float:
    """Return the end stop's force on joint coordinate i (positive upwards)."""
    if position > p.upper[i]:
        return -stop_force(
            p.stop_stiffness[i], p.stop_travel[i], p.stop_damping_speed[i], position - p.upper[i], speed
        )
    if position < p.lower[i]:
        return stop_force(
            p.stop_stiffness[i], p.stop_travel[i], p.stop_damping_speed[i], p.lower[i] - position, -speed
        )
    return 0.0


@compiled
def head_geometry(r: Any, p: Any, y: Any) -> Head:
    """Return the face centre's x, y (m), theta_t (rad), vx, vy (m/s), omega (rad/s) from state vector `y`.

    With a flexible shaft the face rides on the deflected head and turns with the shaft's end slope, 1.5
    times deflection over length (cantilever under an end load).
    """
    a1 = y[0]
    a2 = a1 + y[1]
    a3 = a2 + y[2]
    w1 = y[3]
    w2 = w1 + y[4]
    w3 = w2 + y[5]
    c3, s3 = cos(a3), sin(a3)
    x = r.l12 * cos(a1) + r.l23 * cos(a2) + r.l3t * c3 - s3 * y[13]
    h = r.l12 * sin(a1) + r.l23 * sin(a2) + r.l3t * s3 + c3 * y[13]
    vx = -r.l12 * sin(a1) * w1 - r.l23 * sin(a2) * w2 - (r.l3t * s3 + c3 * y[13]) * w3 - s3 * y[14]
    vy = r.l12 * cos(a1) * w1 + r.l23 * cos(a2) * w2 + (r.l3t * c3 - s3 * y[13]) * w3 + c3 * y[14]
    slope = 1.5 / p.head_distance
    return x, h, a3 + slope * y[13], vx, vy, w3 + slope * y[14]


@compiled
def _derivative(
    r: Any,
    p: Any,
    y: Any,
    x1: float,
    x2: float,
    x3: float,
    vents_open: bool,
    supply_on: bool,
    level: float,
    dy: Any,
    effort: Any,
) -> float:
    """Write dy/dt of the smooth part of the plant; `x` are the spools' openings."""
    q1, q2, q3, u1, u2, u3 = y[0], y[1], y[2], y[3], y[4], y[5]
    supply, atmosphere = y[12], p.atmosphere
    m11, m12, m13, m22, m23, m33, h1, h2, h3, arm_lever = kane_terms(r, q1, q2, q3, u1, u2, u3)

    dx, dh = r.l62 + r.l23 * cos(q2), r.l23 * sin(q2)
    extension = sqrt(dx * dx + dh * dh) - r.l56
    stroke, wrist_lever = wrist_stroke(p, q3)
    taken = 0.0
    for i in range(3):
        if i == 0:
            position, lever, opening, stop_at, stop_speed, stop_lever = q1, 1.0, x1, q1, u1, 1.0
            speed = u1
        elif i == 1:
            speed = arm_lever * u2
            position, lever, opening, stop_at, stop_speed, stop_lever = (
                extension, arm_lever, x2, extension, speed, arm_lever,
            )  # fmt: skip
        else:
            speed = wrist_lever * u3
            position, lever, opening, stop_at, stop_speed, stop_lever = stroke, wrist_lever, x3, q3, u3, 1.0
        a, b = 6 + 2 * i, 7 + 2 * i
        pa, pb = y[a], y[b]
        force = (pa - atmosphere) * p.area_a[i] - (pb - atmosphere) * p.area_b[i]
        effort[i] = force * lever if i == 2 else force
        stop = _stop(p, i, stop_at, stop_speed) * stop_lever
        dy[3 + i] = (force - p.viscous[i] * speed) * lever + stop

        # Metering edges: P->A with B->R when the opening is positive, mirrored when negative.
        band = p.dead_band[i]
        fill_a = p.leakage[i]
        fill_b = p.leakage[i]
        if opening > band:
            fill_a += min((opening - band) / (1.0 - band), 1.0)
        elif opening < -band:
            fill_b += min((-opening - band) / (1.0 - band), 1.0)
        c, ratio = p.conductance[i], p.critical_ratio[i]
        into_a, into_b = flow(c * fill_a, supply, pa, ratio), flow(c * fill_b, supply, pb, ratio)
        across = flow(p.cross_leakage[i], pa, pb, ratio)
        out_a, out_b = flow(c * fill_b, pa, atmosphere, ratio), flow(c * fill_a, pb, atmosphere, ratio)
        if vents_open:
            out_a += flow(p.vent_conductance, pa, atmosphere, ratio)
            out_b += flow(p.vent_conductance, pb, atmosphere, ratio)
        smallest = 0.2 * p.dead_volume[i]
        volume_a = max(p.dead_volume[i] + p.area_a[i] * (position - p.volume_lower[i]), smallest)
        volume_b = max(p.dead_volume[i] + p.area_b[i] * (p.volume_upper[i] - position), smallest)
        dy[a] = p.exponent / volume_a * (into_a - across - out_a - pa * p.area_a[i] * speed)
        dy[b] = p.exponent / volume_b * (into_b + across - out_b + pb * p.area_b[i] * speed)
        taken += into_a + into_b
    if supply_on:
        feed = max(flow(p.feed_conductance * level, p.regulated, supply, 0.3), 0.0)
    else:
        feed = -flow(p.dump_conductance, supply, atmosphere, 0.3)
    dy[12] = p.exponent / p.manifold * (feed - taken)

    f1, f2, f3 = dy[3] - h1, dy[4] - h2, dy[5] - h3
    x, h, _, _, vy, _ = head_geometry(r, p, y)
    a12 = q1 + q2
    jx2, jy2 = h - r.l12 * sin(q1), x - r.l12 * cos(q1)
    jx3, jy3 = jx2 - r.l23 * sin(a12), jy2 - r.l23 * cos(a12)
    depth = p.ground - (h - p.sole_depth)
    if depth > 0.0:
        push = stop_force(p.ground_stiffness, 1.0, 1.0, depth, -vy)
        f1 += x * push
        f2 += jy2 * push
        f3 += jy3 * push
    dy[13] = dy[14] = 0.0
    if p.flexible:
        # The head's mass m rides across the shaft on a spring; along the shaft it is carried rigidly.
        a3 = a12 + q3
        c3, s3 = cos(a3), sin(a3)
        lag = r.l3t - p.head_distance
        k1, k2, k3 = -h + lag * s3, -jx2 + lag * s3, -jx3 + lag * s3
        l1, l2, l3 = x - lag * c3, jy2 - lag * c3, jy3 - lag * c3
        along1, along2, along3 = c3 * k1 + s3 * l1, c3 * k2 + s3 * l2, c3 * k3 + s3 * l3
        across1, across2, across3 = c3 * l1 - s3 * k1, c3 * l2 - s3 * k2, c3 * l3 - s3 * k3
        w1, w2, w3 = u1, u1 + u2, u1 + u2 + u3
        reach_x = p.head_distance * c3 - s3 * y[13]
        reach_y = p.head_distance * s3 + c3 * y[13]
        bias_x = -r.l12 * cos(q1) * w1 * w1 - r.l23 * cos(a12) * w2 * w2 - reach_x * w3 * w3
        bias_y = -r.l12 * sin(q1) * w1 * w1 - r.l23 * sin(a12) * w2 * w2 - reach_y * w3 * w3 + r.gravity
        bias_x -= 2.0 * w3 * y[14] * c3
        bias_y -= 2.0 * w3 * y[14] * s3
        mass = p.head_mass
        spring = p.head_stiffness * y[13] + p.head_damping * y[14]
        pull = mass * (c3 * bias_x + s3 * bias_y)
        m11 += mass * along1 * along1
        m12 += mass * along1 * along2
        m13 += mass * along1 * along3
        m22 += mass * along2 * along2
        m23 += mass * along2 * along3
        m33 += mass * along3 * along3
        f1 += across1 * spring - along1 * pull
        f2 += across2 * spring - along2 * pull
        f3 += across3 * spring - along3 * pull
        a1, a2, a3_ = solve_symmetric(m11, m12, m13, m22, m23, m33, f1, f2, f3)
        dy[13] = y[14]
        dy[14] = (
            -spring / mass
            - (c3 * bias_y - s3 * bias_x)
            - (across1 * a1 + across2 * a2 + across3 * a3_)
        )  # fmt: skip
    else:
        a1, a2, a3_ = solve_symmetric(m11, m12, m13, m22, m23, m33, f1, f2, f3)
    dy[0], dy[1], dy[2] = u1, u2, u3
    dy[3], dy[4], dy[5] = a1, a2, a3_
    return taken


@compiled
def _between(start: float, middle: float, end: float, fraction: float) -> float:
    """Return the parabola through three equally spaced values at `fraction` 0..1."""
    return (
        start * (1.0 - fraction) * (1.0 - 2.0 * fraction)
        + middle * 4.0 * fraction * (1.0 - fraction)
        + end * fraction * (2.0 * fraction - 1.0)
    )


@compiled
def _runge_kutta(
    r: Any,
    p: Any,
    y: Any,
    nodes: Any,
    begin: float,
    end: float,
    step: float,
    vents_open: bool,
    supply_on: bool,
    level: float,
    work: Any,
    effort: Any,
    out: Any,
) -> None:
    """Write into `out` the state after the part begin..end (0..1) of a substep of `step` s from `y`."""
    h = (end - begin) * step
    middle = 0.5 * (begin + end)
    for stage in range(4):
        at = begin if stage == 0 else (end if stage == 3 else middle)
        if stage == 0:
            for k in range(_STATES):
                work[4, k] = y[k]
        else:
            part = h if stage == 3 else 0.5 * h
            for k in range(_STATES):
                work[4, k] = y[k] + part * work[stage - 1, k]
        _derivative(
            r, p, work[4],
            _between(nodes[0, 0], nodes[1, 0], nodes[2, 0], at),
            _between(nodes[0, 1], nodes[1, 1], nodes[2, 1], at),
            _between(nodes[0, 2], nodes[1, 2], nodes[2, 2], at),
            vents_open, supply_on, level, work[stage], effort,
        )  # fmt: skip
    sixth = h / 6.0
    for k in range(_STATES):
        out[k] = y[k] + sixth * (work[0, k] + 2.0 * (work[1, k] + work[2, k]) + work[3, k])


@compiled
def _rub(r: Any, p: Any, y: Any, interval: float) -> None:
    """Let dry friction act on the speeds in `y` for `interval` s."""
    q2, q3 = y[1], y[2]
    m11, m12, m13, m22, m23, m33, _, _, _, arm_lever = kane_terms(r, y[0], q2, q3, 0.0, 0.0, 0.0)
    _, wrist_lever = wrist_stroke(p, q3)
    b1 = friction_bound(p.coulomb[0], p.static[0], p.stribeck_speed[0], y[3])
    b2 = abs(arm_lever) * friction_bound(p.coulomb[1], p.static[1], p.stribeck_speed[1], arm_lever * y[4])
    b3 = abs(wrist_lever) * friction_bound(p.coulomb[2], p.static[2], p.stribeck_speed[2], wrist_lever * y[5])
    y[3], y[4], y[5] = friction_impulse(
        m11, m12, m13, m22, m23, m33, y[3], y[4], y[5], b1 * interval, b2 * interval, b3 * interval
    )


@compiled
def _gap(r: Any, p: Any, impact: Any, y: Any) -> float:
    """Return how far the ball is ahead of the face (m); below zero the face has passed it."""
    x, h, theta, _, _, _ = head_geometry(r, p, y)
    return face_gap(x, h, theta, p.ball_x, p.ball_y, impact)


@compiled
def _strike_ball(r: Any, p: Any, impact: Any, s: Any, y: Any) -> None:
    """Let the club hit the ball: one impulse, on the ball and, reversed, on the robot."""
    x, h, theta, vx, vy, omega = head_geometry(r, p, y)
    s.impact_head[0], s.impact_head[1], s.impact_head[2] = x, h, theta
    s.impact_head[3], s.impact_head[4], s.impact_head[5] = vx, vy, omega
    velocity, spin, _, push = impact_in_plane(x, h, theta, vx, vy, omega, p.ball_x, p.ball_y, impact)
    impulse_x, impulse_y, moment = push
    for k in range(3):
        s.ball_velocity[k] = velocity[k]
        s.ball_spin[k] = spin[k]
    s.impulse[0], s.impulse[1], s.impulse[2] = impulse_x, impulse_y, moment
    if p.flexible:
        # In 0.45 ms the spring moves nothing: the head alone takes the cross-shaft part.
        c3, s3 = cos(theta), sin(theta)
        y[14] += (c3 * impulse_y - s3 * impulse_x) / p.head_mass
        along = c3 * impulse_x + s3 * impulse_y
        impulse_x, impulse_y, moment = along * c3, along * s3, 0.0
    m11, m12, m13, m22, m23, m33, _, _, _, _ = kane_terms(r, y[0], y[1], y[2], 0.0, 0.0, 0.0)
    a12 = y[0] + y[1]
    x2, h2 = x - r.l12 * cos(y[0]), h - r.l12 * sin(y[0])
    x3, h3 = x2 - r.l23 * cos(a12), h2 - r.l23 * sin(a12)
    d1, d2, d3 = solve_symmetric(
        m11, m12, m13, m22, m23, m33,
        x * impulse_y - h * impulse_x + moment,
        x2 * impulse_y - h2 * impulse_x + moment,
        x3 * impulse_y - h3 * impulse_x + moment,
    )  # fmt: skip
    y[3] += d1
    y[4] += d2
    y[5] += d3
    s.struck = True
    s.ball_present = False


@compiled
def _find_impact(
    r: Any,
    p: Any,
    impact: Any,
    y: Any,
    nodes: Any,
    step: float,
    vents_open: bool,
    supply_on: bool,
    level: float,
    work: Any,
    effort: Any,
    trial: Any,
    gap_before: float,
) -> float:
    """Return the fraction of the substep at which the face meets the ball; `trial` is the state there.

    Illinois method on partial steps; the gap is found to 1e-12 m, far below the 0.1 mm that matters.
    """
    low, high = 0.0, 1.0
    gap_low, gap_high = gap_before, _gap(r, p, impact, trial)
    fraction, side = 1.0, 0
    for _ in range(40):
        fraction = (low * gap_high - high * gap_low) / (gap_high - gap_low)
        _runge_kutta(r, p, y, nodes, 0.0, fraction, step, vents_open, supply_on, level, work, effort, trial)
        gap = _gap(r, p, impact, trial)
        if abs(gap) < 1e-12:
            break
        if gap > 0.0:
            low, gap_low = fraction, gap
            if side == 1:
                gap_high *= 0.5
            side = 1
        else:
            high, gap_high = fraction, gap
            if side == -1:
                gap_low *= 0.5
            side = -1
    return fraction


@compiled
def _contact(r: Any, p: Any, y: Any, i: int) -> tuple[float, float]:
    """Return stop coordinate i (rad or m) and the stop's force on it at state vector `y`."""
    if i == 1:
        dx, dh = r.l62 + r.l23 * cos(y[1]), r.l23 * sin(y[1])
        length = sqrt(dx * dx + dh * dh)
        position, speed = length - r.l56, -r.l62 * r.l23 * sin(y[1]) / length * y[4]
    else:
        position, speed = y[i], y[3 + i]
    return position, _stop(p, i, position, speed)


@compiled
def _note_stops(r: Any, p: Any, s: Any, y: Any, contact: Any) -> None:
    """Keep the energy that each cushion has taken and how deep it was pressed in."""
    for i in range(3):
        position, force = _contact(r, p, y, i)
        below, above = p.lower[i] - position, position - p.upper[i]
        if below > 0.0 or above > 0.0:
            side = 0 if below > 0.0 else 1
            # Work against the stop; what it gives back in the rebound is not taken off.
            s.stop_work[i] += max(-0.5 * (force + contact[i, 1]) * (position - contact[i, 0]), 0.0)
            s.stop_energy[i, side] = max(s.stop_energy[i, side], s.stop_work[i])
            s.stop_depth[i, side] = max(s.stop_depth[i, side], below, above)
        else:
            s.stop_work[i] = 0.0
        contact[i, 0], contact[i, 1] = position, force


@compiled
def advance(robot: Any, plant: Any, impact: Any, state: Any, command: Any) -> None:
    """Move `state` (PLANT_STATE, in place) over one tick with `command` (COMMAND) held constant.

    Arguments are one-element arrays: ROBOT, PLANT_PARAMETERS, IMPACT, PLANT_STATE, COMMAND.
    """
    r, p, s, c = robot[0], plant[0], state[0], command[0]
    work = np.empty((5, _STATES))
    nodes = np.empty((3, 3))
    effort = np.empty(3)
    y, trial = np.empty(_STATES), np.empty(_STATES)
    step = p.tick / p.substeps
    if c.tee and not s.tee_before:
        s.ball_present, s.struck = True, False
    s.tee_before = c.tee
    s.guard_locked = s.guard_closed and c.guard_lock
    supply_on = c.supply_enable
    s.supply_level = min(s.supply_level + p.tick / p.soft_start_time, 1.0) if supply_on else 0.0
    s.vent_timer = 0.0 if c.exhaust_closed else s.vent_timer + p.tick
    vents_open = s.vent_timer > p.vent_delay

    for i in range(3):
        y[i], y[3 + i] = s.angle[i], s.speed[i]
    for i in range(6):
        y[6 + i] = s.pressure[i]
    y[12], y[13], y[14] = s.supply_pressure, s.flex, s.flex_speed

    contact = np.empty((3, 2))
    for i in range(3):
        contact[i, 0], contact[i, 1] = _contact(r, p, y, i)

    _rub(r, p, y, 0.5 * step)
    for n in range(p.substeps):
        for i in range(3):
            nodes[0, i] = s.spool[i]
            for half in range(1, 3):
                offset = s.spool[i] - c.valve[i]
                rate = s.spool_speed[i]
                s.spool[i] = c.valve[i] + p.spool[i, 0] * offset + p.spool[i, 1] * rate
                s.spool_speed[i] = p.spool[i, 2] * offset + p.spool[i, 3] * rate
                nodes[half, i] = s.spool[i]
        _runge_kutta(
            r, p, y, nodes, 0.0, 1.0, step, vents_open, supply_on, s.supply_level, work, effort, trial
        )
        start = 0.0
        if s.ball_present and _gap(r, p, impact, trial) <= 0.0:
            gap_before = _gap(r, p, impact, y)
            if gap_before > 0.0:
                start = _find_impact(
                    r, p, impact, y, nodes, step, vents_open, supply_on, s.supply_level, work, effort, trial,
                    gap_before,
                )  # fmt: skip
                for k in range(_STATES):
                    y[k] = trial[k]
                s.impact_time = s.time + (n + start) * step
                _strike_ball(r, p, impact, s, y)
                _runge_kutta(
                    r,
                    p,
                    y,
                    nodes,
                    start,
                    1.0,
                    step,
                    vents_open,
                    supply_on,
                    s.supply_level,
                    work,
                    effort,
                    trial,
                )
        for k in range(_STATES):
            y[k] = trial[k]
        _rub(r, p, y, step if n < p.substeps - 1 else 0.5 * step)
        _note_stops(r, p, s, y, contact)
        s.history_index = (s.history_index + 1) % HISTORY
        for i in range(3):
            s.history[s.history_index, i] = y[i]
    s.time += p.tick
    for i in range(3):
        s.angle[i], s.speed[i], s.effort[i] = y[i], y[3 + i], effort[i]
    for i in range(6):
        s.pressure[i] = y[6 + i]
    s.supply_pressure, s.flex, s.flex_speed = y[12], y[13], y[14]
    if supply_on:
        s.air_used += (
            p.tick
            * max(flow(p.feed_conductance * s.supply_level, p.regulated, y[12], 0.3), 0.0)
            / (287.05 * 293.15)
        )
    for i in range(6):
        s.peak_pressure[i] = max(s.peak_pressure[i], y[6 + i])
    s.head[0], s.head[1], s.head[2], s.head[3], s.head[4], s.head[5] = head_geometry(r, p, y)
    s.lowest_clearance = min(s.lowest_clearance, s.head[1] - p.sole_depth - p.ground)
    s.peak_head_speed = max(s.peak_head_speed, sqrt(s.head[3] * s.head[3] + s.head[4] * s.head[4]))


@compiled
def _uniform(s: Any) -> float:
    """Return the next random number in (0, 1) of the state's own stream (SplitMix64, Steele 2014)."""
    s.random = s.random + np.uint64(0x9E3779B97F4A7C15)
    z = s.random
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (float(z >> np.uint64(11)) + 0.5) / 9007199254740992.0


@compiled
def _normal(s: Any) -> float:
    """Return the next normally distributed number (Box and Muller 1958)."""
    return sqrt(-2.0 * log(_uniform(s))) * cos(2.0 * pi * _uniform(s))


@compiled
def sense(plant: Any, state: Any, readings: Any) -> None:
    """Write what the sensors show of `state` into `readings` (READINGS); noise is drawn from its stream."""
    p, s, out = plant[0], state[0], readings[0]
    substep = p.tick / p.substeps
    out.time = s.time
    for i in range(3):
        age = p.latency
        if p.jitter > 0.0:
            age = max(age + p.jitter * _normal(s), 0.0)
        back = min(age / substep, HISTORY - 2.0)
        whole = int(back)
        part = back - whole
        newer = s.history[(s.history_index - whole + HISTORY) % HISTORY, i]
        older = s.history[(s.history_index - whole - 1 + HISTORY) % HISTORY, i]
        angle = newer + part * (older - newer)
        if p.noise > 0.0:
            angle += p.noise * _normal(s)
        out.encoder_count[i] = floor(angle * p.encoder_scale) % p.encoder_counts
        out.encoder_time[i] = s.time - p.latency
        out.encoder_valid[i] = s.encoder_valid[i]
        out.encoder_age[i] = p.latency
    out.emergency_stop_clear = s.emergency_stop_clear
    out.guard_closed = s.guard_closed
    out.guard_locked = s.guard_locked
    out.supply_pressure = s.supply_pressure
    out.local_reset = s.local_reset
    out.ball_present = s.ball_present
    for i in range(6):
        out.chamber_pressure[i] = s.pressure[i]
