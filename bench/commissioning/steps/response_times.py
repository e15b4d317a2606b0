"""Step 5: the spools' frequency and the encoders' latency, from small steps.

A valve that opens at a stop fills a chamber as its spool moves; a bus or device delays command and pressure
by a dead time. A joint that coasts with closed valves compresses its air: pressures show its position, and
the encoder shows it later. The latency found is that of the encoders behind the pressure sensors, with the
dead time added: a loop that commands by its encoders waits for both.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from bench.commissioning.machine.commissioning_step import (
    FOLD_ORDER,
    CommissioningStep,
    MachineFault,
    ParameterEstimate,
    RobotEstimate,
    StepResult,
    Traces,
    beyond,
    centres,
    fold,
    joint_angles,
    move_to_stop,
    openings,
    run_slowly,
)
from bench.commissioning.machine.machine import (
    Array,
    CommissionedMachine,
    MotionTrace,
    Segment,
    Until,
    at_rows,
)
from bench.commissioning.steps.pneumatic_identification import (
    AirTrace,
    nominal_values,
    robust_errors,
    spool_path,
    way_per_angle,
)
from bench.control.measured_plant import with_values
from drivers.base import JOINTS
from sim.driver import joint_travel
from sim.plant import ACTUATOR_KEYS

_STEP, _PUSH = 0.15, 0.08
"""Valve commands beyond the dead band: step of a spool, push before a joint coasts."""
_OPEN, _BETWEEN, _PULSES = 0.06, 0.4, 5
"""Duration of a step, pause between two (s), and their number."""
_COAST, _PUSHES = 0.3, (0.3, 0.2)
"""Duration of coasting (s); fractions of the travel at which it starts."""
_SEEN = 0.08
"""Part of a step's response that counts (s)."""
_MIN_FREQUENCY = 2.0 * np.pi * 20.0
"""Natural frequency of a spool below which it sticks, rad/s."""
_MIN_COAST_SPEED = 0.05
"""Mean speed below which a coasting joint says nothing about its encoder (rad/s)."""
_MAX_LATENCY = 0.005
"""Max latency of an encoder (s)."""
_CERTAIN = 3.0
"""Standard errors by which a latency is beyond its bound."""
_IMPOSSIBLE = (
    "an encoder cannot be read before its motion; its latency is taken as 0. The pressures were later while "
    "the joints coasted than during the steps: a busy bus, or a filter of the pressure sensors. Compare "
    "canopen.pressure_ticks and the sensors' filters, relieve the bus, then repeat the commissioning"
)
"""Finding of a latency below zero."""
_MAX_DEAD_TIME = 0.010
"""Max dead time of a valve (s)."""
_SUBSTEPS = 8
"""Steps of a tick in which a spool's motion and the flow through it are computed."""
_MIN_LATENCY_ERROR = 3e-5
"""Smallest standard error of the latency, s: a small part of the tick between two readings."""
_PRESSURE_ERROR = 100.0
"""Standard error of a pressure (Pa)."""


def _measure(machine: CommissionedMachine, known: RobotEstimate) -> Traces:
    """Step each valve at its lower stop, then let each joint coast with closed valves."""
    machine.vent()
    fold(machine, known)
    traces: dict[str, MotionTrace] = {}
    for i, joint in enumerate(JOINTS):
        doing = f"{joint} valve stepped at its stop"
        traces[f"{joint} steps"] = run_slowly(machine, known, _pulses(known, i), doing)
    for i, joint in enumerate(JOINTS):
        for n, share in enumerate(_PUSHES):
            push = _push(known, i, share)
            traces[f"{joint} coasting {n + 1}"] = run_slowly(machine, known, push, f"{joint} pushed")
            move_to_stop(machine, known, i, "lower", FOLD_ORDER)
    machine.vent()
    return traces


def _estimate(traces: Traces, known: RobotEstimate) -> StepResult:
    """Return the natural frequency of each spool, and the encoders' latency."""
    values, notes, dead_times = [], [], []
    for i, key in enumerate(ACTUATOR_KEYS):
        (value, error), dead_time = fit_spool(traces[f"{JOINTS[i]} steps"], known, i)
        dead_times.append(dead_time)
        if value < _MIN_FREQUENCY:
            raise MachineFault(
                f"{JOINTS[i]} valve",
                f"its spool follows with {value / (2 * np.pi):.0f} Hz only",
                f"at least {_MIN_FREQUENCY / (2 * np.pi):.0f} Hz",
                "The spool sticks: clean the valve, check the air's filter, or replace the valve.",
            )
        values.append(ParameterEstimate(f"{key}.valve.natural_frequency", value, error, "rad/s"))
    latencies = []
    for i, joint in enumerate(JOINTS):
        for name, trace in traces.items():
            if name.startswith(f"{joint} coasting"):
                found = fit_latency(trace, known, i)
                if found is not None:
                    _require_quick(joint, *found)
                    latencies.append(found)
                    notes.append(f"{name}: encoder {_behind(*found)} the pressures")
    dead, dead_error = _weighted(np.array(dead_times))
    notes.append(f"dead time from a command to its pressure: {1e3 * dead:.3f} ± {1e3 * dead_error:.3f} ms")
    if latencies:
        value, error = _weighted(np.array(latencies))
        value, error = value + dead, float(np.hypot(np.hypot(error, dead_error), _MIN_LATENCY_ERROR))
        notes.append(f"encoders with that dead time: {_behind(value, error)} the motion")
        if value < -_CERTAIN * error:
            notes.append(_IMPOSSIBLE)
        values.append(ParameterEstimate("encoders.latency", max(value, 0.0), error, "s"))
    else:
        notes.append("no joint coasted: the encoders' latency stays a guess")
    return StepResult(tuple(values), tuple(notes))


RESPONSE = CommissioningStep(
    "response",
    "Frequency of the spools, latency of the encoders",
    "steps of 0.15 for 60 ms at a stop and pushes over a third of the travel, at 4.5 bar absolute",
    _measure,
    _estimate,
)
"""Step 5."""


def _behind(delay: float, error: float) -> str:
    """Return `delay` ± `error` (s) of a reading in words; pressures may be the later ones."""
    return f"{1e3 * abs(delay):.3f} ± {1e3 * error:.3f} ms {'before' if delay < 0.0 else 'behind'}"


def _require_quick(joint: str, latency: float, error: float) -> None:
    """Raise MachineFault if the encoder of `joint` lags by more than an encoder may."""
    if latency - _CERTAIN * error > _MAX_LATENCY:
        found = f"{1e3 * latency:.1f} ms later than the pressures"
        action = "Check the encoder's cycle time and filters on the bus."
        raise MachineFault(f"{joint} encoder", found, f"at most {1e3 * _MAX_LATENCY:.0f} ms", action)


def _pulses(known: RobotEstimate, joint: int) -> tuple[Segment, ...]:
    at = partial(openings, known, joint)
    closed, opened = at(centres(known)[joint]), at(beyond(known, joint, "lower", _STEP))
    rest = Segment(_BETWEEN, closed)
    return (rest, *((Segment(_OPEN, opened), rest) * _PULSES))


def _push(known: RobotEstimate, joint: int, share: float) -> tuple[Segment, ...]:
    travel = np.ptp(np.array(joint_travel(known.plant)), axis=0)[joint]

    at = partial(openings, known, joint)
    closed = at(centres(known)[joint])
    return (
        Segment(1.0, closed),
        Segment(
            4.0,
            at(beyond(known, joint, "upper", _PUSH)),
            vents_shut=True,
            until=Until("moved", joint, share * travel),
        ),
        Segment(_COAST, closed, vents_shut=True),
        Segment(1.0, closed),
    )


def fit_spool(
    trace: MotionTrace, known: RobotEstimate, actuator: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the spool's natural frequency (rad/s) of `actuator` with its error, from steps at a stop.

    And the dead time (s) from command to pressure, with its error.
    """
    plant = replace(known.plant, tick=known.plant.tick / _SUBSTEPS)
    air = AirTrace(_refined(trace, known.plant.tick), actuator, plant)
    values = nominal_values(known, actuator)
    nominal = plant.actuators[actuator].valve.natural_frequency
    rows = _SUBSTEPS * _answers(trace, known.plant.tick)
    clusters = np.repeat(np.arange(len(rows)), rows.shape[1])
    chamber, time = 1, air.tick * np.arange(len(air.command))  # the chamber towards the lower stop

    def residual(x: Array) -> Array:
        valve = with_values(
            plant, {f"{ACTUATOR_KEYS[actuator]}.valve.natural_frequency": nominal * float(x[0])}
        ).actuators[actuator]
        path = spool_path(air.command, valve.valve.half_step_matrix(air.tick).ravel())
        air.spool = np.interp(time - _MAX_DEAD_TIME * x[2], time, path)
        scaled = values.copy()
        scaled[3] *= x[1]
        content, added = air.content(scaled)
        gap = (content - added)[rows, chamber]
        slope = content[rows, chamber] / air.pressure[rows, chamber] / air.exponent
        gap = (gap - gap[:, :1]) / slope
        return np.concatenate([(gap / _PRESSURE_ERROR).ravel(), [(x[1] - 1.0) / 0.05]])

    bounds = [0.05, 0.5, 0.0], [5.0, 2.0, 1.0]
    starts = (least_squares(residual, [1.0, 1.0, x], bounds=bounds, xtol=1e-9) for x in (0.01, 0.3))
    found = min(starts, key=lambda one: float(one.cost))
    error = robust_errors(np.asarray(found.jac), np.asarray(found.fun), clusters)
    relative = float(np.hypot(error[0], 0.01))
    frequency = nominal * float(found.x[0]), nominal * relative
    return frequency, (_MAX_DEAD_TIME * float(found.x[2]), _MAX_DEAD_TIME * float(error[2]))


def _refined(trace: MotionTrace, tick: float) -> MotionTrace:
    """Return `trace`, of one row a `tick` (s), with as many rows a tick as a spool's motion needs."""
    at = np.arange((len(trace.time) - 1) * _SUBSTEPS + 1) / _SUBSTEPS
    row, number = at.astype(np.int64), np.arange(len(trace.time))
    return replace(
        trace,
        time=trace.time[0] + at * tick,
        count=trace.count[row],
        pressure=at_rows(trace.pressure, at),
        supply=np.interp(at, number, trace.supply),
        valve=trace.valve[row],
        vents_shut=trace.vents_shut[row],
        segment=trace.segment[row],
    )


def _answers(trace: MotionTrace, tick: float) -> NDArray[np.int64]:
    """Return the rows (pulses, n) of the answers to the steps."""
    opened = np.flatnonzero(np.diff(trace.segment % 2) > 0) + 1
    length = round(_SEEN / tick)
    return np.array(
        [np.arange(row - 1, row - 1 + length) for row in opened if row + length < len(trace.time)]
    )


def fit_latency(trace: MotionTrace, known: RobotEstimate, joint: int) -> tuple[float, float] | None:
    """Return latency (s) of the encoder of `joint` and its error from coasting; None if it hardly moved."""
    plant = known.plant
    angle = joint_angles(trace, plant)[:, joint]
    rows = np.flatnonzero(trace.of_segment(2))
    settled = round(0.02 / plant.tick)
    rows = rows[settled:]
    if len(rows) < 100:
        return None
    speed = savgol_filter(angle, 11, 2, deriv=1, delta=plant.tick)[rows]
    _, upper = joint_travel(plant)
    if np.abs(speed).mean() < _MIN_COAST_SPEED or angle[rows].max() > upper[joint] - 0.02:
        return None
    shown = _shown_by_pressures(trace, known, joint, rows)
    time = (rows - rows[0]) * plant.tick
    latencies = []
    for chamber in range(2):
        late = angle[rows] - shown[:, chamber]
        # Offset, leak, a wrong volume, and the latency itself, of second order in it.
        basis = np.stack([np.ones_like(time), time, angle[rows] - angle[rows[0]], -speed, time**2], axis=1)
        solution, *_ = np.linalg.lstsq(basis, late, rcond=None)
        left = late - basis @ solution
        blocks = (time / 0.02).astype(np.int64)
        noise = max(float(np.std(left)), 1e-6)
        error = robust_errors(basis / noise, left / noise, blocks)
        latencies.append((float(solution[3]), float(error[3])))
    value, error_ = _weighted(np.array(latencies))
    return value, error_


def _shown_by_pressures(
    trace: MotionTrace, known: RobotEstimate, joint: int, rows: NDArray[np.int64]
) -> Array:
    """Return the joint's angles (m, 2) at `rows`, inferred from the pressures of chambers A and B (rad)."""
    plant = known.plant
    air = AirTrace(trace, joint, plant)
    values = nominal_values(known, joint)
    content, added = air.content(values)
    start = rows[0]
    power = 1.0 / air.exponent
    volume = (content[start] + added[rows] - added[start]) / air.pressure[rows] ** power
    stroke_a = (volume[:, 0] - values[2]) / values[0]
    stroke_b = (volume[:, 1] - values[2]) / values[1]
    angle = joint_angles(trace, plant)[:, joint]
    position_a = stroke_a - air.stroke_a[rows]
    position_b = air.stroke_b[rows] - stroke_b
    # Small differences of the actuator's coordinate, turned into angles by its lever at each row.
    lever = way_per_angle(angle[rows], joint, plant)
    return np.stack([angle[rows] + position_a / lever, angle[rows] + position_b / lever], axis=1)


def _weighted(values: Array) -> tuple[float, float]:
    """Return the weighted mean of `values` (n, 2: value, error), and its error by their scatter."""
    weight = 1.0 / values[:, 1] ** 2
    mean = float((values[:, 0] * weight).sum() / weight.sum())
    error = float(weight.sum() ** -0.5)
    if len(values) > 1:
        spread = float((weight * (values[:, 0] - mean) ** 2).sum() / (len(values) - 1))
        error *= max(1.0, spread**0.5)
    return mean, error
