"""Step 4: friction and gravity from slow moves, areas once more, and the supply in service.

While one joint moves slowly and the others rest parked, its chambers' force is gravity, friction and a little
inertia. The force is known by the areas of step 3, whose scale is part of the errors; the masses are those of
the configuration within their tolerance. Pauses on the way show the force that breaks the joint loose.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from bench.commissioning.air_fit import VENT_TOLERANCE, joint_angles, robust_errors, way_per_angle
from bench.commissioning.known_robot import ACTUATOR_KEYS, FoundValue, KnownRobot
from bench.commissioning.machine import Array, CommissionedMachine, MotionTrace, Segment, Until
from bench.commissioning.moves import (
    FOLD_ORDER,
    PRESSING,
    Side,
    beyond,
    centres,
    fold,
    openings,
    require_within,
    slow_bounds,
)
from bench.commissioning.steps import StepResult, Traces
from bench.commissioning.wrong_machine import WrongMachine
from drivers.base import JOINTS, Triple
from sim.driver import joint_travel
from sim.kane import bias_forces, inverse_dynamics
from sim.plant import PlantParameters

_OPENINGS = (0.05, 0.08, 0.12)
_LEVEL, _PAUSE, _BREAK = 8.0, 1.0, 3.0
"""s: of a move at most, of a pause, of the ramp that breaks a joint loose."""
_PAUSES = (0.3, 0.6)
"""Shares of the travel at which the joint pauses."""
_SMOOTH = 41
"""Rows of the smoothing polynomial of third degree."""
_SEEN = 1e-4
"""rad by which a joint has moved that broke loose."""
_SPACING = 10
"""Rows between those that count."""
_CONTACT = 0.02
"""rad from the stops in which a joint may touch them."""
_SLIDING = 0.02
"""rad/s from which a joint slides."""
_MASSES = 0.06
"""Standard deviation of masses and inertias before anything was measured, as a share."""
LOWEST_SUPPLY = 6.3e5
"""Min pressure in service, Pa absolute."""
_DELAY = 0.0015
"""Standard deviation of the time, s, by which encoders may lag behind pressures."""
_LEAST_BREAKS = 3
"""Min number of times that a joint broke loose for a static friction of its own."""
_GAUGE = 500.0
"""Error of the supply's pressure, Pa: of the flow through leaking valves."""


class FrictionFit(NamedTuple):
    """Friction of an actuator in its own coordinate, and factors on gravity and inertia."""

    coulomb: float
    static: float
    viscous: float
    gravity: float
    """Factor on the configured gravity load."""
    inertia: float
    """Factor on the configured inertia."""
    error: Array
    """Standard errors (5,) of these."""


class SlowMoves:
    """Step 4."""

    name = "friction"
    title = "Friction, gravity, supply in service"
    bounds_text = (
        "openings up to 0.12 beyond the edge at 4.5 bar absolute, vents open; then the supply in service, "
        "spools centred"
    )

    def measure(self, machine: CommissionedMachine, known: KnownRobot) -> Traces:
        """Move each joint up and down slowly, with pauses; then read the supply's pressure in service."""
        machine.vent()
        fold(machine, known)
        machine.set_supply(PRESSING)
        traces: dict[str, MotionTrace] = {}
        for i in FOLD_ORDER[::-1]:
            for opening in _OPENINGS:
                for side in ("upper", "lower"):
                    trace = _move(machine, known, i, "upper" if side == "upper" else "lower", opening)
                    traces[f"{JOINTS[i]} to {side} {opening}"] = trace
        machine.vent()
        machine.set_supply(float("inf"))
        trace = machine.run((Segment(2.0, centres(known)),), slow_bounds(known.plant, 12e5))
        require_within(trace, "supply in service")
        traces["supply"] = trace
        machine.vent()
        return traces

    def estimate(self, traces: Traces, known: KnownRobot) -> StepResult:
        """Return friction of all actuators and the pressure of the supply."""
        values: list[FoundValue] = []
        notes: list[str] = []
        plant = known.plant
        for i, key in enumerate(ACTUATOR_KEYS):
            own = [trace for name, trace in traces.items() if name.startswith(f"{JOINTS[i]} ")]
            fit = fit_friction(own, plant, i)
            unit = "N m" if i == 0 else "N"
            rows = (
                ("coulomb", fit.coulomb, fit.error[0], unit),
                ("static", max(fit.static, fit.coulomb), fit.error[1], unit),
                ("viscous", fit.viscous, fit.error[2], f"{unit} s/{'rad' if i == 0 else 'm'}"),
            )
            for name, value, error, text in rows:
                values.append(FoundValue(f"{key}.friction.{name}", value, float(error), text, self.name))
            notes.append(
                f"{JOINTS[i]}: gravity {fit.gravity:.3f} ± {fit.error[3]:.3f} times, inertia "
                f"{fit.inertia:.3f} ± {fit.error[4]:.3f} times the configured one"
            )
        values.append(_supply(traces["supply"]))
        return StepResult(tuple(values), tuple(notes))


def _supply(trace: MotionTrace) -> FoundValue:
    last = trace.supply[len(trace.supply) // 2 :]
    pressure = float(np.median(last))
    if pressure < LOWEST_SUPPLY:
        raise WrongMachine(
            "supply",
            f"{1e-5 * pressure:.2f} bar absolute in service",
            f"at least {1e-5 * LOWEST_SUPPLY:.1f} bar absolute",
            "The supply is too low: check compressor, regulator, filter and hoses.",
        )
    error = max(_GAUGE, float(np.ptp(last)))
    return FoundValue("supply.pressure", pressure, error, "Pa absolute", SlowMoves.name)


def _move(
    machine: CommissionedMachine, known: KnownRobot, joint: int, side: Side, opening: float
) -> MotionTrace:
    """Return the trace of `joint` moving to `side` with pauses."""
    travel = np.ptp(np.array(joint_travel(known.plant)), axis=0)[joint]

    def at(command: float) -> Triple:
        return openings(known, FOLD_ORDER, **{JOINTS[joint]: command})

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
    trace = machine.run(tuple(segments), slow_bounds(known.plant, 1.2 * PRESSING))
    require_within(trace, f"{JOINTS[joint]} moved slowly to its {side} stop")
    return trace


def fit_friction(traces: list[MotionTrace], plant: PlantParameters, joint: int) -> FrictionFit:
    """Return friction of the actuator of `joint` from slow moves, with the areas of `plant`."""
    parts = [_equations(trace, plant, joint, n) for n, trace in enumerate(traces)]
    columns, force = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
    clusters = np.concatenate([p[2] for p in parts])
    friction = plant.actuators[joint].friction
    # Unknowns: Coulomb, its rise towards standstill, viscous, factors on gravity and inertia, delay.
    scale = np.array([friction.coulomb, friction.coulomb, friction.viscous, 1.0, 1.0, _DELAY])
    mean = np.array([1.0, 0.33, 1.0, 1.0, 1.0, 0.0])
    prior = np.array([2.0, 1.0, 2.0, _MASSES, 2 * _MASSES, 1.0])
    design = columns * scale
    x, noise = mean.copy(), max(float(np.abs(force).max()), 1.0)
    left, weight = design @ x - force, np.full(len(force), 1.0 / noise)
    for _ in range(5):
        x = _solved(design, force, weight, mean, prior)
        left = design @ x - force
        noise = max(1.4826 * float(np.median(np.abs(left))), 1e-4 * float(np.abs(force).max()))
        weight = 1.0 / np.maximum(np.abs(left) / (3.0 * noise), 1.0) / noise
    rows = np.concatenate([design * weight[:, None], np.diag(1.0 / prior)])
    residual = np.concatenate([left * weight, (x - mean) / prior])
    error = np.hypot(robust_errors(rows, residual, clusters), VENT_TOLERANCE * np.abs(x)) * scale
    found = x * scale
    static, static_error = float(found[0] + found[1]), float(np.hypot(error[0], error[1]))
    broke = [value for trace in traces for value in break_away(trace, plant, joint, float(x[3]))]
    if len(broke) >= _LEAST_BREAKS:
        own = float(np.median(broke))
        own_error = float(np.std(broke, ddof=1)) / np.sqrt(len(broke)) + VENT_TOLERANCE * own
        static, static_error = own, max(own_error, min(abs(own - static) / 2, static_error))
    errors = np.array([error[0], static_error, error[2], error[3], error[4]])
    return FrictionFit(float(found[0]), static, float(found[2]), float(x[3]), float(x[4]), errors)


def _solved(design: Array, force: Array, weight: Array, mean: Array, prior: Array) -> Array:
    """Return the weighted least squares of `design` x = `force` with priors `mean` and their deviations."""
    rows = np.concatenate([design * weight[:, None], np.diag(1.0 / prior)])
    wanted = np.concatenate([force * weight, mean / prior])
    return np.asarray(np.linalg.lstsq(rows, wanted, rcond=None)[0])


def _equations(
    trace: MotionTrace, plant: PlantParameters, joint: int, number: int
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return what balances (m, 6) the air's torque on the joint, that torque (m,) N m, and blocks (m,)."""
    angle = joint_angles(trace, plant)
    window = min(_SMOOTH, len(angle) - 1 + len(angle) % 2)
    if window < 7:
        return np.zeros((0, 6)), np.zeros(0), np.zeros(0, np.int64)
    tick = plant.tick
    smooth = savgol_filter(angle, window, 3, axis=0)
    speed = savgol_filter(angle, window, 3, deriv=1, delta=tick, axis=0)
    acceleration = savgol_filter(angle, window, 3, deriv=2, delta=tick, axis=0)
    lower, upper = joint_travel(plant)
    free = (angle[:, joint] > lower[joint] + _CONTACT) & (angle[:, joint] < upper[joint] - _CONTACT)
    moving = np.abs(speed[:, joint]) > _SLIDING
    good = free & moving
    # Only where the whole smoothing window slides in one direction, away from the stops.
    half = window // 2
    bad = np.flatnonzero(~good)
    for row in bad:
        good[max(row - half, 0) : row + half + 1] = False
    rows = np.flatnonzero(good)[::_SPACING]
    if not len(rows):
        return np.zeros((0, 6)), np.zeros(0), np.zeros(0, np.int64)
    q, u = smooth[rows], speed[rows]
    lever = way_per_angle(q[:, joint], joint, plant)
    load = np.asarray(bias_forces(plant.robot, q, np.zeros_like(u)))[:, joint]
    inertia = np.asarray(_torque(plant, smooth, speed, acceleration))[:, joint]
    inertia -= np.asarray(bias_forces(plant.robot, smooth, np.zeros_like(speed)))[:, joint]
    actuator = plant.actuators[joint]
    pressure = trace.pressure[rows, 2 * joint : 2 * joint + 2] - plant.supply.atmosphere
    along = u[:, joint] * lever
    direction = np.sign(along)
    rise = direction * np.exp(-((along / actuator.friction.stribeck_speed) ** 2))
    columns = np.stack(
        [
            direction * lever,
            rise * lever,
            along * lever,
            load,
            inertia[rows],
            np.gradient(inertia, tick)[rows],
        ],
        axis=1,
    )
    force = (pressure[:, 0] * actuator.area_a - pressure[:, 1] * actuator.area_b) * lever
    blocks = 100 * number + trace.segment[rows]
    return columns, force, blocks


def _torque(plant: PlantParameters, q: Array, u: Array, a: Array) -> Array:
    """Return the joints' torques (n, 3) N m that the motion needs."""
    effort = np.asarray(inverse_dynamics(plant.robot, q, u, a)).copy()
    effort[:, 1] *= way_per_angle(q[:, 1], 1, plant)
    return effort


def break_away(trace: MotionTrace, plant: PlantParameters, joint: int, gravity: float) -> list[float]:
    """Return the friction forces at which `joint` broke loose in the ramps of `trace`.

    `gravity` is the factor on the configured load.
    """
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
        found.append(float(direction * (force - gravity * load / lever)))
    return found
