"""Step 4: friction and masses from slow moves, and the supply in service.

While one joint moves slowly and the others rest parked, its chambers' force is gravity, friction and a little
inertia. The force is known by the areas of step 3, whose scale is part of the errors; masses and inertias are
those of the configuration within their tolerance, as far as the moves do not say more. Pauses on the way show
the force that breaks the joint loose.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.optimize import lsq_linear
from scipy.signal import savgol_filter

from bench.commissioning.machine.commissioning_step import (
    FOLD_ORDER,
    SIDES,
    CommissioningStep,
    MachineFault,
    ParameterEstimate,
    RobotEstimate,
    Side,
    StepResult,
    Traces,
    beyond,
    centres,
    fold,
    joint_angles,
    openings,
    run_slowly,
)
from bench.commissioning.machine.machine import Array, CommissionedMachine, MotionTrace, Segment, Until
from bench.commissioning.steps.pneumatic_identification import (
    VENT_TOLERANCE,
    robust_errors,
    way_per_angle,
)
from bench.control.measured_plant import value_at, with_values
from drivers.base import JOINTS
from sim.driver import joint_travel
from sim.kane import bias_forces, inverse_dynamics
from sim.plant import ACTUATOR_KEYS, PlantParameters

_BODIES = ("shoulder_link", "left_arm", "rod", "cylinder")
_OPENINGS = (0.05, 0.08, 0.12)
_LEVEL, _PAUSE, _BREAK = 8.0, 1.0, 3.0
"""Max duration of a move, of a pause, and of the ramp that breaks a joint loose, s."""
_PAUSES = (0.3, 0.6)
"""Shares of the travel at which the joint pauses."""
_SMOOTH, _SPAN = 11, 40
"""Rows of the parabola that gives a speed, and of an equation."""
_SEEN = 1e-4
"""Movement of a joint that broke loose (rad)."""
_SPACING = 10
"""Rows between those that count."""
_CONTACT = 0.02
"""Distance from the stops within which a joint may touch them (rad)."""
_SLIDING = 0.02
"""Speed from which a joint slides (rad/s)."""
MASSES = (
    *(f"robot.{body}.{what}" for body in _BODIES for what in ("mass", "inertia")),
    "robot.club.head_mass",
    "robot.club.shaft_mass",
)
"""Masses and inertias that are fitted, by their keys."""
_TOLERANCE = 0.07
"""Standard deviation of masses and inertias before anything was measured, as a share."""
_MIN_TORQUE_SCATTER = 0.01
"""Smallest scatter of torques, N m."""
_FRICTION = ("coulomb", "static", "viscous")
MIN_SUPPLY = 6.3e5
"""Min pressure in service, Pa absolute."""
_ACCELERATION = 0.02
"""Standard deviation of the error of an acceleration that encoders give, as a share."""
_DELAY = 0.0015
"""Standard deviation of the time, s, by which encoders may lag behind pressures."""
_MIN_BREAKS = 3
"""Min number of break-aways of a joint for the static friction to be their median."""
_GAUGE = 500.0
"""Min error of the supply pressure, Pa: the flow through leaking valves causes it."""


class SlowFit(NamedTuple):
    """Friction of the actuators in their own coordinates, and the masses."""

    friction: Array
    """(3, 3) Coulomb, static and viscous friction by actuator."""
    friction_error: Array
    """(3, 3) their standard errors."""
    masses: Array
    """(m,) in the order of MASSES."""
    mass_error: Array
    residual: Array
    """(3,) scatter of the torques, N m."""


def _measure_friction(machine: CommissionedMachine, known: RobotEstimate) -> Traces:
    """Move each joint up and down slowly, with pauses; then read the supply's pressure in service."""
    machine.vent()
    fold(machine, known)
    traces: dict[str, MotionTrace] = {}
    for i in FOLD_ORDER[::-1]:
        for opening in _OPENINGS:
            for side in SIDES:
                traces[f"{JOINTS[i]} to {side} {opening}"] = _move(machine, known, i, side, opening)
    machine.vent()
    machine.set_supply(float("inf"))
    rest = (Segment(2.0, centres(known)),)
    traces["supply"] = run_slowly(machine, known, rest, "supply in service", 12e5)
    machine.vent()
    return traces


def _estimate_friction(traces: Traces, known: RobotEstimate) -> StepResult:
    """Return friction of all actuators and the pressure of the supply."""
    values: list[ParameterEstimate] = []
    notes: list[str] = []
    own = [[t for name, t in traces.items() if name.startswith(f"{joint} ")] for joint in JOINTS]
    fit = fit_slow_moves(own, known.plant)
    for i, key in enumerate(ACTUATOR_KEYS):
        unit = "N m" if i == 0 else "N"
        units = (unit, unit, f"{unit} s/{'rad' if i == 0 else 'm'}")
        rows = zip(_FRICTION, fit.friction[i], fit.friction_error[i], units, strict=True)
        for name, value, error, text in rows:
            values.append(ParameterEstimate(f"{key}.friction.{name}", float(value), float(error), text))
        notes.append(f"{JOINTS[i]}: torques fit within {fit.residual[i]:.2f} N m")
    for key, value, error in zip(MASSES, fit.masses, fit.mass_error, strict=True):
        text = "kg m2" if key.endswith("inertia") else "kg"
        values.append(ParameterEstimate(key, float(value), float(error), text))
    values.append(_supply(traces["supply"]))
    return StepResult(tuple(values), tuple(notes))


FRICTION = CommissioningStep(
    "friction",
    "Friction, masses, supply in service",
    "openings up to 0.12 beyond the edge at 4.5 bar absolute, vents open; then the supply in service, "
    "spools centred",
    _measure_friction,
    _estimate_friction,
)
"""Step 4."""


def _supply(trace: MotionTrace) -> ParameterEstimate:
    last = trace.supply[len(trace.supply) // 2 :]
    pressure = float(np.median(last))
    if pressure < MIN_SUPPLY:
        found = f"{1e-5 * pressure:.2f} bar absolute in service"
        action = "The supply is too low: check compressor, regulator, filter and hoses."
        raise MachineFault("supply", found, f"at least {1e-5 * MIN_SUPPLY:.1f} bar absolute", action)
    error = max(_GAUGE, float(np.ptp(last)))
    return ParameterEstimate("supply.pressure", pressure, error, "Pa absolute")


def _move(
    machine: CommissionedMachine, known: RobotEstimate, joint: int, side: Side, opening: float
) -> MotionTrace:
    """Return the trace of `joint` moving to `side` with pauses."""
    travel = np.ptp(np.array(joint_travel(known.plant)), axis=0)[joint]

    at = partial(openings, known, joint)
    edge, moving = (beyond(known, joint, side, x) for x in (0.0, opening))
    segments = []
    for share in _PAUSES:
        reached = Until("moved", joint, share * travel)
        loose = Until("moved", joint, (share + 0.05) * travel)
        segments += [
            Segment(_LEVEL, at(moving), until=reached),
            Segment(_PAUSE, at(centres(known)[joint])),
            Segment(_BREAK, at(edge), at(beyond(known, joint, side, _OPENINGS[-1])), until=loose),
        ]
    segments.append(Segment(_LEVEL, at(moving), until=Until("rested", joint, 0.8)))
    last = at(beyond(known, joint, side, _OPENINGS[-1]))
    segments.append(Segment(_LEVEL, last, until=Until("rested", joint, 0.8)))
    doing = f"{JOINTS[joint]} moved slowly to its {side} stop"
    return run_slowly(machine, known, tuple(segments), doing)


def fit_slow_moves(traces: Sequence[Sequence[MotionTrace]], plant: PlantParameters) -> SlowFit:
    """Return friction and masses from slow moves (3, n) of the joints, with the areas of `plant`.

    All joints carry the same masses, whose sum of effects is known better than each of them.
    """
    designs, torques, clusters, joints = [], [], [], []
    for i, own in enumerate(traces):
        parts = [_equations(trace, plant, i, 1000 * i + n) for n, trace in enumerate(own)]
        columns = np.concatenate([part[0] for part in parts])
        design = np.zeros((len(columns), 5 * 3 + len(MASSES)))
        design[:, 5 * i : 5 * i + 5], design[:, 15:] = columns[:, :5], columns[:, 5:]
        designs.append(design)
        torques.append(np.concatenate([part[1] for part in parts]))
        clusters.append(np.concatenate([part[2] for part in parts]))
        joints.append(np.full(len(columns), i))
    nominal = [(f.coulomb, f.coulomb, f.viscous, _DELAY, 1.0) for f in (a.friction for a in plant.actuators)]
    scale = np.concatenate([np.ravel(nominal), np.ones(len(MASSES))])
    mean = np.concatenate([np.tile([1.0, 0.33, 1.0, 0.0, 0.0], 3), np.zeros(len(MASSES))])
    prior = np.concatenate(
        [np.tile([2.0, 1.0, 2.0, 1.0, _ACCELERATION], 3), np.full(len(MASSES), _TOLERANCE)]
    )
    design, torque, joint = np.concatenate(designs) * scale, np.concatenate(torques), np.concatenate(joints)
    x, noise = mean.copy(), np.array([np.abs(own).max(initial=1.0) for own in torques])
    left, weight = design @ x - torque, 1.0 / noise[joint]
    for _ in range(6):
        x = _solved(design, torque, weight, mean, prior)
        left = design @ x - torque
        noise = np.array(
            [max(1.4826 * _median(np.abs(left[joint == i])), _MIN_TORQUE_SCATTER) for i in range(3)]
        )
        weight = 1.0 / np.maximum(np.abs(left) / (3.0 * noise[joint]), 1.0) / noise[joint]
    rows = np.concatenate([design * weight[:, None], np.diag(1.0 / prior)])
    error = robust_errors(rows, np.concatenate([left * weight, (x - mean) / prior]), np.concatenate(clusters))
    masses = np.array([value_at(plant, key) for key in MASSES]) * (1.0 + x[15:])
    error[15:] = np.hypot(error[15:], VENT_TOLERANCE)
    found = (x * scale)[:15].reshape(3, 5)
    errors = np.hypot(error[:15], VENT_TOLERANCE * np.abs(x[:15])).reshape(3, 5) * scale[:15].reshape(3, 5)
    weighed = with_values(plant, dict(zip(MASSES, masses.tolist(), strict=True)))
    static = [_static(own, weighed, i, found[i], errors[i]) for i, own in enumerate(traces)]
    friction = np.stack(
        [found[:, 0], [max(s[0], f[0]) for s, f in zip(static, found, strict=True)], found[:, 2]]
    )
    friction_error = np.stack([errors[:, 0], [s[1] for s in static], errors[:, 2]])
    return SlowFit(friction.T, friction_error.T, masses, masses * error[15:], noise)


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _static(
    traces: Sequence[MotionTrace], plant: PlantParameters, joint: int, found: Array, errors: Array
) -> tuple[float, float]:
    """Return static friction and its error: where the joint broke loose, else by sliding friction's rise."""
    static, error = float(found[0] + found[1]), float(np.hypot(errors[0], errors[1]))
    broke = [value for trace in traces for value in break_away(trace, plant, joint)]
    if len(broke) < _MIN_BREAKS:
        return static, error
    own = float(np.median(broke))
    own_error = float(np.std(broke, ddof=1)) / np.sqrt(len(broke)) + VENT_TOLERANCE * own
    return own, max(own_error, min(abs(own - static) / 2, error))


def _solved(design: Array, force: Array, weight: Array, mean: Array, prior: Array) -> Array:
    """Return the weighted least squares of `design` x = `force` with priors `mean` and their deviations.

    No friction is negative.
    """
    rows = np.concatenate([design * weight[:, None], np.diag(1.0 / prior)])
    wanted = np.concatenate([force * weight, mean / prior])
    least = np.concatenate([np.tile([0.0, 0.0, 0.0, -np.inf, -np.inf], 3), np.full(len(MASSES), -np.inf)])
    return np.asarray(lsq_linear(rows, wanted, (least, np.inf), method="bvls").x)


def _equations(
    trace: MotionTrace, plant: PlantParameters, joint: int, number: int
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return the effects (k, 5 + m) of friction, delay and masses on a joint's torque, N m.

    And the air's torque less that of the configured masses (k,) N m, and the blocks (k,) that err alike.
    """
    angle, tick = joint_angles(trace, plant), plant.tick
    if len(angle) < 4 * _SPAN:
        return np.zeros((0, 5 + len(MASSES))), np.zeros(0), np.zeros(0, np.int64)
    speed = savgol_filter(angle, _SMOOTH, 2, deriv=1, delta=tick, axis=0)
    # The mean of an acceleration over a span is a difference of speeds; all else is also averaged over it.
    acceleration = np.zeros_like(speed)
    half = _SPAN // 2
    acceleration[half:-half] = (speed[2 * half :] - speed[: -2 * half]) / (2 * half * tick)
    rows = _sliding(angle[:, joint], speed[:, joint], joint_travel(plant), joint)
    lever = way_per_angle(angle[:, joint], joint, plant)
    actuator = plant.actuators[joint]
    pressure = trace.pressure[:, 2 * joint : 2 * joint + 2] - plant.supply.atmosphere
    along = speed[:, joint] * lever
    direction = np.sign(along)
    rise = direction * np.exp(-((along / actuator.friction.stribeck_speed) ** 2))
    air = (pressure[:, 0] * actuator.area_a - pressure[:, 1] * actuator.area_b) * lever

    def averaged(values: Array) -> Array:
        return np.asarray(uniform_filter1d(values, 2 * half + 1, axis=0))

    def needed(robot: PlantParameters) -> tuple[Array, Array]:
        """Return the averaged torque that gravity and motion need, and its part for acceleration."""
        bias = np.asarray(bias_forces(robot.robot, angle, speed))[:, joint]
        load = np.asarray(bias_forces(robot.robot, angle, np.zeros_like(speed)))[:, joint]
        inertia = np.asarray(_torque(robot, angle, np.zeros_like(speed), acceleration))[:, joint] - load
        return averaged(bias) + inertia, inertia

    base, inertia = needed(plant)
    effects = []
    for key in MASSES:
        heavier = with_values(plant, {key: 1.1 * float(value_at(plant, key))})
        effects.append((needed(heavier)[0] - base) / 0.1)
    sliding = averaged(np.stack([direction * lever, rise * lever, along * lever, air], axis=1))
    columns = np.stack([*sliding[:, :3].T, np.gradient(inertia, tick), inertia, *effects], axis=1)
    return columns[rows], (sliding[:, 3] - base)[rows], 100 * number + trace.segment[rows]


def _sliding(angle: Array, speed: Array, travel: tuple[Array, Array], joint: int) -> NDArray[np.int64]:
    """Return rows around which `joint` slides in one direction, away from its stops, for a whole span."""
    lower, upper = travel[0][joint], travel[1][joint]
    good = (angle > lower + _CONTACT) & (angle < upper - _CONTACT) & (np.abs(speed) > _SLIDING)
    span = _SPAN // 2 + _SMOOTH
    for row in np.flatnonzero(~good):
        good[max(row - span, 0) : row + span + 1] = False
    return np.flatnonzero(good)[::_SPACING]


def _torque(plant: PlantParameters, q: Array, u: Array, a: Array) -> Array:
    """Return the joints' torques (n, 3) N m that the motion needs."""
    effort = np.asarray(inverse_dynamics(plant.robot, q, u, a)).copy()
    effort[:, 1] *= way_per_angle(q[:, 1], 1, plant)
    return effort


def break_away(trace: MotionTrace, plant: PlantParameters, joint: int) -> list[float]:
    """Return the friction forces at which `joint` broke loose in the ramps of `trace`."""
    angle = joint_angles(trace, plant)
    actuator = plant.actuators[joint]
    lower, upper = joint_travel(plant)
    found = []
    for segment in (2, 5):
        rows = np.flatnonzero(trace.of_segment(segment))
        if len(rows) < 100 or not (segment < len(trace.ended) and trace.ended[segment]):
            continue
        own = angle[rows, joint]
        start = float(np.median(own[:20]))
        if np.abs(own - start).max() <= 8.0 * _SEEN:
            continue
        if np.ptp(own[:50]) > 3e-4 or not lower[joint] + _CONTACT < start < upper[joint] - _CONTACT:
            continue
        # A force that rises evenly moves a mass by the third power of time.
        seen, later = (int(np.flatnonzero(np.abs(own - start) > way)[0]) for way in (_SEEN, 8.0 * _SEEN))
        at = rows[max(2 * seen - later, 0)]
        pose = angle[at]
        lever = float(way_per_angle(pose[[joint]], joint, plant)[0])
        load = float(bias_forces(plant.robot, pose, np.zeros(3))[joint])
        gauge = trace.pressure[at, 2 * joint : 2 * joint + 2] - plant.supply.atmosphere
        force = gauge[0] * actuator.area_a - gauge[1] * actuator.area_b
        direction = np.sign(own[later] - start)
        found.append(float(direction * (force - load / lever)))
    return found
