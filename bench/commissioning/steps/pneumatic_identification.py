"""Step 3: an actuator's air from traces: areas, dead volume, valve and leakage by least squares.

Filling and decay at the stops give leakage, dead volumes, effective areas and the valves' flow. At a stop the
volumes are dead volume plus area times way: both stops together give both. What closed chambers lose or gain
says what leaks, and how they empty through the vents says how large they are.

Air in a chamber of volume V obeys d(p^(1/n) V)/dt = q p^(1/n - 1), whether or not its joint moves, with q the
flows through valve, seals and vents. Integrated over short windows this needs no derivative of a noisy
pressure. All flows are proportional to a conductance; the vents' throttles, which the maker states, give the
absolute scale of all the others, and of the volumes: their tolerance is part of each error.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from math import pi
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bench.commissioning.machine.commissioning_step import (
    CommissioningStep,
    MachineFault,
    ParameterEstimate,
    RobotEstimate,
    Side,
    StepResult,
    Traces,
    at_both_stops,
    beyond,
    centres,
    joint_angles,
    openings,
    run_slowly,
)
from bench.commissioning.machine.machine import Array, CommissionedMachine, MotionTrace, Segment, Until
from drivers.base import JOINTS
from drivers.base.compiled import compiled_with_arrays
from sim.driver import joint_travel
from sim.kinematics import right_arm_length
from sim.plant import ACTUATOR_KEYS, PlantParameters, build_plant
from sim.pneumatics import flow

NAMES = (
    "area_a",
    "area_b",
    "dead_volume",
    "valve.conductance",
    "valve.critical_ratio",
    "valve.centre",
    "valve.dead_band",
    "valve.leakage",
    "cross_leakage",
)
"""Fitted values of an actuator, by their keys in its table."""
UNITS = ("m2, vane m3/rad", "m2, vane m3/rad", "m3", "m3/(s Pa)", "", "", "", "", "m3/(s Pa)")
_RELATIVE = (True, True, True, True, False, False, False, False, False)
_SCALED = (True, True, True, True, False, False, False, False, True)
"""Which values are proportional to the vents' conductance."""
_UNIT_STEPS = (1.0, 1.0, 1.0, 1.0, 0.1, 0.01, 0.01, 1e-3, 2e-11)
"""Sizes of one unit of the search: shares of the nominal value, or absolute."""
_PRIOR = (0.3, 0.3, 0.5, 0.5, 3.0, 5.0, 5.0, 6.0, 6.0)
"""Standard deviations of the values before anything was measured, in units of the search."""
_LOWER_BOUNDS = (0.3, 0.3, 0.2, 0.3, 0.5, -20.0, 0.0, 0.0, 0.0)
_UPPER_BOUNDS = (3.0, 3.0, 4.0, 3.0, 9.0, 20.0, 50.0, 100.0, 1000.0)
VENT_TOLERANCE = 0.02
"""Standard error of the vents' throttles, as a share."""
_WINDOW = 0.02
"""Length of a window, s."""
_SETTLED = 0.03
"""Time after a jump of an opening in which the spool may still move (s)."""
_ERROR = 200.0
"""Error of a pressure at a window's end that counts as one (Pa)."""
_ZERO_ERROR = 0.005
"""Error of an encoder's zero before homing (rad)."""
_ALIKE = 5.0
"""Neighbouring windows that err alike and count as one."""
_MIN_ERROR = 0.01
"""Smallest standard error in units of the search: no model is truer."""


class AirFit(NamedTuple):
    """Fitted air of an actuator; values and errors in the order of NAMES."""

    values: Array
    error: Array
    """Standard errors."""
    residual: float
    """Root mean square of the pressures' errors, Pa."""


@compiled_with_arrays
def spool_path(command: Any, matrix: Any) -> Any:
    """Return the spool's openings (n,) at the rows of `command` (n,); `matrix` (4,) propagates one row."""
    path = np.empty(len(command))
    opening, rate = command[0], 0.0
    for k in range(len(command)):
        path[k] = opening
        offset = opening - command[k]
        opening = command[k] + matrix[0] * offset + matrix[1] * rate
        rate = matrix[2] * offset + matrix[3] * rate
    return path


@compiled_with_arrays
def chamber_flows(opening: Any, pressure: Any, supply: Any, vent: Any, values: Any, atmosphere: float) -> Any:
    """Return the flows into chambers A and B (n, 2), m' R T (W), of `pressure` (n, 2) Pa.

    `opening` (n,) from the spool's centre, `supply` (n,) Pa, `vent` (n,) conductance of a chamber's vent,
    `values` (5,): conductance, critical ratio, dead band, leakage, cross leakage.
    """
    out = np.empty((len(opening), 2))
    edge, ratio, band, leakage, cross = values[0], values[1], values[2], values[3], values[4]
    for k in range(len(opening)):
        x, pa, pb = opening[k], pressure[k, 0], pressure[k, 1]
        edge_a = edge * (leakage + min(max((x - band) / (1.0 - band), 0.0), 1.0))
        edge_b = edge * (leakage + min(max((-x - band) / (1.0 - band), 0.0), 1.0))
        across = flow(cross, pa, pb, ratio)
        out[k, 0] = (
            flow(edge_a, supply[k], pa, ratio) - across - flow(edge_b + vent[k], pa, atmosphere, ratio)
        )
        out[k, 1] = (
            flow(edge_b, supply[k], pb, ratio) + across - flow(edge_a + vent[k], pb, atmosphere, ratio)
        )
    return out


def cylinder_positions(angle: Array, joint: int, plant: PlantParameters) -> Array:
    """Return the actuator's coordinate (n,) of `joint` at `angle` (n,) rad: rad, m, m."""
    if joint == 0:
        return angle
    if joint == 1:
        return np.asarray(right_arm_length(plant.robot, angle) - plant.robot.l56)
    return plant.wrist_stroke(angle)


def way_per_angle(angle: Array, joint: int, plant: PlantParameters) -> Array:
    """Return the actuator's way per angle (n,) at the angles (n,) rad of `joint`: 1, m/rad, m/rad."""
    step = 1e-5
    high, low = (cylinder_positions(angle + way, joint, plant) for way in (step, -step))
    return np.asarray((high - low) / (2 * step))


class AirTrace:
    """A trace of one actuator prepared for the fit."""

    def __init__(self, trace: MotionTrace, actuator: int, plant: PlantParameters) -> None:
        """Take the rows of `trace` that `actuator` needs."""
        record = build_plant(plant).plant
        self.pressure = np.ascontiguousarray(trace.pressure[:, 2 * actuator : 2 * actuator + 2])
        self.supply, self.vents_shut = trace.supply, trace.vents_shut
        self.command = np.ascontiguousarray(trace.valve[:, actuator])
        self.tick, self.segment = plant.tick, trace.segment
        position = cylinder_positions(joint_angles(trace, plant)[:, actuator], actuator, plant)
        self.stroke_a = position - record["volume_lower"][0, actuator]
        self.stroke_b = record["volume_upper"][0, actuator] - position
        valve = plant.actuators[actuator].valve
        self.spool = spool_path(self.command, valve.half_step_matrix(plant.tick).ravel())
        self.vent = np.where(_open(self.vents_shut, plant), plant.supply.vent_conductance, 0.0)
        self.exponent, self.atmosphere = plant.supply.polytropic_exponent, plant.supply.atmosphere

    def windows(self) -> NDArray[np.int64]:
        """Return the first and last rows (m, 2) of windows without a jump of an opening or of the vents."""
        length, settled = round(_WINDOW / self.tick), round(_SETTLED / self.tick)
        jumps = np.abs(np.diff(self.command)) > 2e-3
        jumps |= np.diff(self.vent) != 0.0
        disturbed = np.zeros(len(self.command), bool)
        disturbed[:settled] = True  # earlier commands are unknown
        for row in np.flatnonzero(jumps):
            disturbed[row : row + settled] = True
        starts = np.arange(0, len(self.command) - length, length)
        rows = np.array([s for s in starts if not disturbed[s : s + length + 1].any()], dtype=np.int64)
        return np.stack([rows, rows + length], axis=1) if len(rows) else np.zeros((0, 2), np.int64)

    def content(self, values: Array, offset: float = 0.0) -> tuple[Array, Array]:
        """Return p^(1/n) V of both chambers (n, 2), and its increase by the flows since the first row (n, 2).

        `values` are in the order of NAMES; `offset` is added to the actuator's coordinate.
        """
        power = 1.0 / self.exponent
        volume = np.stack(
            [
                values[2] + values[0] * (self.stroke_a + offset),
                values[2] + values[1] * (self.stroke_b - offset),
            ],
            axis=1,
        )
        valve = np.array([values[3], values[4], values[6], values[7], values[8]])
        flows = chamber_flows(
            self.spool - values[5], self.pressure, self.supply, self.vent, valve, self.atmosphere
        )
        rate = flows * self.pressure ** (power - 1.0)
        added = np.zeros_like(rate)
        added[1:] = np.cumsum(rate[1:] + rate[:-1], axis=0) * (self.tick / 2)
        return volume * self.pressure**power, added

    def errors(self, values: Array, rows: NDArray[np.int64], offset: float = 0.0) -> Array:
        """Return the pressures' errors (m, 2) Pa over windows `rows` (m, 2)."""
        content, added = self.content(values, offset)
        first, last = rows[:, 0], rows[:, 1]
        gap = content[last] - content[first] - (added[last] - added[first])
        # d(p^(1/n) V) / dp
        slope = content[last] / self.pressure[last] / self.exponent
        return np.asarray(gap / slope)


def _open(vents_shut: NDArray[np.bool_], plant: PlantParameters) -> NDArray[np.bool_]:
    """Return whether the vents are open (n,), with their opening delay."""
    open_ = np.zeros(len(vents_shut), bool)
    since = np.inf
    for k, shut in enumerate(vents_shut):
        since = 0.0 if shut else since + plant.tick
        open_[k] = since > plant.supply.vent_delay
    return open_


def nominal_values(known: RobotEstimate, actuator: int) -> Array:
    """Return the values of `actuator` as far as they are known, in the order of NAMES."""
    return np.array([known.value(f"{ACTUATOR_KEYS[actuator]}.{name}") for name in NAMES])


def fit_air(
    traces: Iterable[MotionTrace], known: RobotEstimate, actuator: int, sure: Sequence[str] = ()
) -> AirFit:
    """Return the air of `actuator` from `traces`; values in `sure` keep their estimates, within errors."""
    plant = known.plant
    nominal = nominal_values(RobotEstimate(known.nominal), actuator)
    start = nominal_values(known, actuator)
    unit = np.where(_RELATIVE, nominal, 1.0) * _UNIT_STEPS
    prior = np.array(_PRIOR)
    for name in sure:
        k = NAMES.index(name)
        prior[k] = max(known.error(f"{ACTUATOR_KEYS[actuator]}.{name}", prior[k] * unit[k]) / unit[k], 1e-3)
    parts = [AirTrace(trace, actuator, plant) for trace in traces]
    rows = [part.windows() for part in parts]
    clusters = np.concatenate(
        [
            1000 * n + np.repeat(part.segment[window[:, 0]], 2)
            for n, (part, window) in enumerate(zip(parts, rows, strict=True))
        ]
    )
    # The last unknown is the error of the coordinate at the stops, which the zero of the encoder leaves.
    unit = np.append(unit, _offset_error(known, actuator))
    prior, mean = np.append(prior, 1.0), np.append(start, 0.0) / unit

    def residual(x: Array) -> Array:
        measured = [
            part.errors(x[:-1] * unit[:-1], window, float(x[-1] * unit[-1])).ravel()
            for part, window in zip(parts, rows, strict=True)
        ]
        return np.concatenate([np.concatenate(measured) / _ERROR, (x - mean) / prior])

    low, high = np.append(_LOWER_BOUNDS, -10.0), np.append(_UPPER_BOUNDS, 10.0)
    found = least_squares(
        residual, np.clip(mean, low + 1e-6, high - 1e-6), bounds=(low, high), xtol=1e-10, ftol=1e-10
    )
    error = robust_errors(np.asarray(found.jac), np.asarray(found.fun), clusters)
    values = (np.asarray(found.x) * unit)[:-1]
    errors = (np.hypot(error, _MIN_ERROR) * unit)[:-1]
    errors = np.where(_SCALED, np.hypot(errors, VENT_TOLERANCE * values), errors)
    # A coordinate that is wrong by opposite amounts at the two stops looks like dead volume.
    errors[2] = np.hypot(errors[2], unit[-1] * max(values[0], values[1]))
    measured = np.asarray(found.fun)[: len(clusters)] * _ERROR
    return AirFit(values, errors, float(np.sqrt(np.mean(measured**2))))


def _offset_error(known: RobotEstimate, actuator: int) -> float:
    """Return the standard error of the actuator's coordinate (rad, m, m)."""
    plant = known.plant
    per_count = 2 * pi / plant.encoders.counts_per_revolution
    zero = known.error(f"encoders.zero_count.{actuator}", _ZERO_ERROR / per_count) * per_count
    lower, upper = joint_travel(plant)
    middle = (lower + upper)[[actuator]] / 2
    return max(zero, 1e-5) * float(abs(way_per_angle(middle, actuator, plant)[0]))


def robust_errors(jacobian: Array, residual: Array, clusters: NDArray[np.int64]) -> Array:
    """Return standard errors (k,) of a fit whose residuals (n,) err alike within `clusters` (m,).

    The rows of `jacobian` (n, k) beyond those of `clusters` are priors. Greater of two: the sandwich of the
    clusters, and the scatter of all with few of them counted as independent.
    """
    normal = np.linalg.inv(jacobian.T @ jacobian)
    score = np.zeros((jacobian.shape[1], jacobian.shape[1]))
    data, seen = jacobian[: len(clusters)], residual[: len(clusters)]
    for cluster in np.unique(clusters):
        rows = clusters == cluster
        total = data[rows].T @ seen[rows]
        score += np.outer(total, total)
    count = len(np.unique(clusters))
    sandwich = np.diag(normal @ score @ normal) * count / max(count - 1, 1)
    scatter = np.diag(normal) * _ALIKE * max(float(np.mean(seen**2)), 1e-4)
    return np.asarray(np.sqrt(np.maximum(sandwich, scatter)))


_FILL, _COUNTER = 0.10, 0.05
"""Openings beyond the edges: filling the chamber that presses the joint, and the other one."""
_HELD = (2, 4)
"""Segments in which all is shut."""
_FULL, _HALF = 2.7e5, 1.8e5
"""Pressures up to which the two are filled, Pa absolute."""
_HOLD, _SHORT_HOLD, _DECAY = 2.5, 0.6, 1.6
"""Durations of the holds and of the decay (s)."""
MAX_LEAKAGE = 0.008
"""Max leakage of a valve that is right, as a share of its full opening."""
MAX_CROSS_LEAKAGE = 2e-10
"""Max leakage past the seals of an actuator that is right, m3/(s Pa)."""


def _estimate_leakage(traces: Traces, known: RobotEstimate) -> StepResult:
    """Return the air of all actuators."""
    values: list[ParameterEstimate] = []
    notes: list[str] = []
    if vents_stay_open(traces, known):
        found = "chambers empty through them when they are commanded shut"
        action = "A vent stays open: check its coil, cable and pilot air, then replace it."
        raise MachineFault("vents", found, "chambers that hold their air", action)
    for i, key in enumerate(ACTUATOR_KEYS):
        sure = [name for name in ("valve.centre", "valve.dead_band") if f"{key}.{name}" in known.found]
        fit = fit_air((traces[f"{JOINTS[i]} lower"], traces[f"{JOINTS[i]} upper"]), known, i, sure)
        _require_tight(i, fit)
        for name, value, error, unit in zip(NAMES, fit.values, fit.error, UNITS, strict=True):
            values.append(ParameterEstimate(f"{key}.{name}", float(value), float(error), unit))
        notes.append(f"{JOINTS[i]}: pressures fit within {fit.residual:.0f} Pa")
    return StepResult(tuple(values), tuple(notes))


def vents_stay_open(traces: Traces, known: RobotEstimate) -> bool:
    """Return whether the chambers of all joints, when closed, behave as with open vents in `traces`."""
    for i, joint in enumerate(JOINTS):
        errors = []
        for vents in (0.0, known.plant.supply.vent_conductance):
            total = 0.0
            for side in ("lower", "upper"):
                air = AirTrace(traces[f"{joint} {side}"], i, known.plant)
                air.vent = np.full(len(air.vent), vents)
                rows = air.windows()
                held = rows[np.isin(air.segment[rows[:, 0]], _HELD)]
                total += float(np.square(air.errors(nominal_values(known, i), held)).sum())
            errors.append(total)
        if errors[1] >= errors[0]:
            return False
    return True


def _require_tight(joint: int, fit: AirFit) -> None:
    leakage, cross = fit.values[NAMES.index("valve.leakage")], fit.values[NAMES.index("cross_leakage")]
    if leakage > MAX_LEAKAGE:
        raise MachineFault(
            f"air of the {JOINTS[joint]}",
            f"closed chambers leak {100 * leakage:.1f} % of the valve's full opening",
            f"up to {100 * MAX_LEAKAGE:.1f} %",
            f"Look for a leaking hose, fitting or valve at the {JOINTS[joint]}, or a vent that stays open.",
        )
    if cross > MAX_CROSS_LEAKAGE:
        location, found = f"air of the {JOINTS[joint]}", f"{cross:.1e} m3/(s Pa) pass from chamber to chamber"
        action = f"The piston's or vane's seals of the {JOINTS[joint]} are worn: replace them."
        raise MachineFault(location, found, f"up to {MAX_CROSS_LEAKAGE:.1e} m3/(s Pa)", action)


def _fill_and_decay(
    machine: CommissionedMachine, known: RobotEstimate, joint: int, side: Side
) -> MotionTrace:
    """Return the trace of `joint` at its stop at `side`: filled, held, counter-filled, held, emptied."""
    other: Side = "lower" if side == "upper" else "upper"
    pressing, counter = (2 * joint, 2 * joint + 1) if side == "upper" else (2 * joint + 1, 2 * joint)

    at = partial(openings, known, joint)
    closed = at(centres(known)[joint])
    return run_slowly(
        machine,
        known,
        (
            Segment(_DECAY, closed),
            Segment(
                6.0,
                at(beyond(known, joint, side, _FILL)),
                vents_shut=True,
                until=Until("above", pressing, _FULL),
            ),
            Segment(_HOLD, closed, vents_shut=True),
            Segment(
                0.25,
                at(beyond(known, joint, other, _COUNTER)),
                vents_shut=True,
                until=Until("above", counter, _HALF),
            ),
            Segment(_SHORT_HOLD, closed, vents_shut=True),
            Segment(_DECAY + known.plant.supply.vent_delay, closed),
        ),
        f"{JOINTS[joint]} filled at its {side} stop",
    )


LEAKAGE = CommissioningStep(
    "leakage",
    "Leakage, dead volumes, effective areas, flow of the valves",
    "chambers up to 2.7 bar absolute at a supply of 3 bar, joints at their stops",
    partial(at_both_stops, trace=_fill_and_decay),
    _estimate_leakage,
)
"""Step 3."""
