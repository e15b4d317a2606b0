"""Steps 1 and 2: wiring of valves and encoders; centres and dead bands of the valves.

Step 1: which valve moves which joint, which encoder sees it, the way it counts and its scale. With hardly any
pressure and the vents open each valve is opened a little to either side: the chamber that fills shows where
it is connected, and the opening at which it begins to fill where its edges are. The joints hardly move. Then
each joint goes from stop to stop at a low pressure: its encoder has to count the travel that the robot's
geometry has.

Step 2: centres and dead bands of the valves, from slow ramps at the stops. A ramp towards the stop at which
the joint stands presses it, so that nothing moves; the chamber fills against its open vent, and the opening
from which it does is the edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.calibration.calibration import MAX_BAND, MAX_CENTRE, zero_counts
from bench.commissioning.machine.commissioning_step import (
    FOLD_ORDER,
    MOVING,
    SIDES,
    CommissioningStep,
    MachineFault,
    ParameterEstimate,
    RobotEstimate,
    Side,
    StepResult,
    StopMove,
    Traces,
    at_both_stops,
    beyond,
    centres,
    move_to_stop,
    openings,
    pressed_to_stop,
    run_slowly,
    swapped_encoders,
    towards_stop,
)
from bench.commissioning.machine.machine import Array, CommissionedMachine, MotionTrace, Segment
from bench.commissioning.steps.pneumatic_identification import NAMES, fit_air, way_per_angle
from bench.control.settings import zero_tolerance
from drivers.base import CHAMBERS, JOINTS, Triple
from sim.driver import joint_travel
from sim.kane import bias_forces
from sim.plant import ACTUATOR_KEYS, PlantParameters

FAINT = 1.3e5
"""Supply of the ramps, Pa absolute."""
_REACH = 0.15
"""Opening to either side."""
_RAMP, _BASELINE = 4.0, 1.0
"""Duration of an opening ramp from one flow direction to the other, and of the pause before it (s)."""
_FOOT = 1.5e3
"""Rise of a chamber where its valve begins to open (Pa)."""
_ANSWER = 8e3
"""Change of a chamber that is connected to the valve (Pa)."""
_RESTED, _FALL, _VENTINGS = 0.4, 500.0, 25
"""Time over which a chamber's pressure falls by less once it is empty (s, Pa), and max ventings."""
_LEFT = 2e4
"""Max pressure of a chamber at the end of a ramp (Pa)."""
_SUPPLY_SHARE = 0.8
"""Min share of the set gauge pressure."""
_SCALE_TOLERANCE = 0.03
"""Max error of an encoder's travel, as a share, in addition to that of the geometry."""
_FREE = 0.9
"""Share of its travel that a joint moves at `MOVING` unless friction holds it."""
_LENGTH = 2e-3
"""Tolerance of the robot's lengths, m."""
_UNIFORM = 3**-0.5


class ValveFeet(NamedTuple):
    """Valve commands at which the chambers of a valve begin to fill."""

    lower: float
    """Command for chamber B."""
    upper: float
    """Command for chamber A."""


def _measure_wiring(machine: CommissionedMachine, known: RobotEstimate) -> Traces:
    """Ramp each valve, then move each joint from stop to stop."""
    _require_sensors(_vent_to_rest(machine), known.plant)
    machine.set_supply(FAINT)
    traces: dict[str, MotionTrace] = {}
    for i in FOLD_ORDER:
        doing = f"{JOINTS[i]} valve a little open"
        traces[f"{JOINTS[i]} ramp"] = run_slowly(machine, known, _ramp(i), doing, 2.0 * FAINT)
    machine.vent()
    known = RobotEstimate(known.plant)
    known.add(_valve_values(traces, known.plant))
    _require_answers(machine, known)
    for i in FOLD_ORDER:
        pressed_to_stop(machine, known, i, "lower", FOLD_ORDER)
    for i in FOLD_ORDER[::-1]:
        for side, name in zip(SIDES, ("up", "back"), strict=True):
            move = f"{JOINTS[i]} {name}"
            traces[move], traces[f"{move}, pressed"] = move_to_stop(machine, known, i, side, FOLD_ORDER)
    machine.vent()
    return traces


def _require_answers(machine: CommissionedMachine, known: RobotEstimate) -> None:
    """Fold the robot and move each joint up and back, at a supply of `MOVING` as far as friction lets it.

    Raises:
        MachineFault: a joint or another encoder than its own answers.
    """
    machine.set_supply(MOVING)
    club, *others = FOLD_ORDER
    towards_stop(machine, known, club, "lower")
    pressed_to_stop(machine, known, club, "lower")  # no zero tells yet whether it is off the ground
    machine.set_supply(MOVING)
    for n, i in enumerate(others, 1):
        towards_stop(machine, known, i, "lower", FOLD_ORDER[:n])
    travel = np.ptp(np.array(joint_travel(known.plant)), axis=0)
    for i in FOLD_ORDER[::-1]:
        ways = [towards_stop(machine, known, i, side, FOLD_ORDER).count[-1] for side in SIDES]
        seen = np.abs(ways)[:, i] * (2 * pi / known.plant.encoders.counts_per_revolution)
        if seen.min() < _FREE * travel[i]:
            ways = [move_to_stop(machine, known, i, side, FOLD_ORDER).way for side in SIDES]
            machine.set_supply(MOVING)
        _require_travel(i, ways[0], known.plant)


def _vent_to_rest(machine: CommissionedMachine) -> MotionTrace:
    """Vent until no chamber's pressure falls, for a limited time; return the last venting."""
    trace = machine.vent()
    for _ in range(_VENTINGS):
        before = int(np.searchsorted(trace.time, trace.time[-1] - _RESTED))
        if np.all(trace.pressure[before] - trace.pressure[-1] <= _FALL):
            break
        trace = machine.vent()
    return trace


def _estimate_wiring(traces: Traces, known: RobotEstimate) -> StepResult:
    """Return the valves' rough centres and bands, and the encoders' signs and zeros."""
    plant = known.plant
    values = _valve_values(traces, plant)
    encoders, notes = _encoder_values(traces, plant)
    return StepResult((*values, *encoders), tuple(notes))


WIRING = CommissioningStep(
    "wiring",
    "Wiring, signs, and scale of the encoders",
    f"ramps at {1e-5 * FAINT:.1f} bar with open vents; first moves at 3 bar, then 4.5 bar absolute; "
    "speeds at which no shock absorber takes more than half its rated energy",
    _measure_wiring,
    _estimate_wiring,
)
"""Step 1."""


def _ramp(valve: int) -> tuple[Segment, ...]:
    def at(opening: float) -> Triple:
        a, b, c = (opening if i == valve else 0.0 for i in range(3))
        return a, b, c

    return (
        Segment(_BASELINE, at(0.0)),
        Segment(_RAMP / 2, at(0.0), at(-_REACH)),
        Segment(_RAMP, at(-_REACH), at(_REACH)),
        Segment(_RAMP, at(_REACH), at(-_REACH)),
        Segment(_RAMP / 2, at(-_REACH), at(0.0)),
    )


def _valve_values(traces: Traces, plant: PlantParameters) -> tuple[ParameterEstimate, ...]:
    """Return rough centres and dead bands; raise MachineFault if a valve is not connected as it should."""
    responses = {i: _response(traces[f"{JOINTS[i]} ramp"]) for i in range(3)}
    _require_supply(traces, plant)
    _require_connected(responses, traces)
    _require_vents(traces, plant)
    values = []
    for i, key in enumerate(ACTUATOR_KEYS):
        feet = valve_feet(traces[f"{JOINTS[i]} ramp"], i)
        centre, band = (feet.lower + feet.upper) / 2, max((feet.upper - feet.lower) / 2, 0.0)
        if abs(centre) > MAX_CENTRE or band > MAX_BAND:
            location = f"{JOINTS[i]} valve"
            expected = f"a centre within {MAX_CENTRE} and an overlap up to {MAX_BAND}"
            action = "Adjust the valve's centre by its maker's manual, or replace the valve."
            raise MachineFault(location, f"centre at {centre:+.3f}, overlap {band:.3f}", expected, action)
        values.append(ParameterEstimate(f"{key}.valve.centre", centre, 0.004))
        values.append(ParameterEstimate(f"{key}.valve.dead_band", band, 0.01))
    return tuple(values)


def _response(trace: MotionTrace) -> Array:
    """Return the rise of all chambers (6,) Pa from the lower end of the ramp to its upper end."""
    rows = np.flatnonzero(trace.of_segment(2))
    edge = max(len(rows) // 40, 1)
    low, high = trace.pressure[rows[:edge]], trace.pressure[rows[-edge:]]
    return np.asarray(high.mean(axis=0) - low.mean(axis=0))


def valve_feet(trace: MotionTrace, valve: int) -> ValveFeet:
    """Return where chambers A and B of `valve` begin to fill in the ramp `trace`."""
    found = []
    for segment, chamber in ((3, 2 * valve + 1), (2, 2 * valve)):
        rows = np.flatnonzero(trace.of_segment(segment))
        pressure = trace.pressure[rows, chamber]
        plateau = pressure[len(rows) // 8 : len(rows) // 3]
        level = np.median(plateau)
        scatter = 1.4826 * np.median(np.abs(plateau - level))
        low = pressure < level + max(_FOOT, 6.0 * scatter)
        last = int(np.flatnonzero(low)[-1]) if low.any() else 0
        found.append(float(trace.valve[rows[last], valve]))
    return ValveFeet(*found)


def _require_sensors(trace: MotionTrace, plant: PlantParameters) -> None:
    """Raise MachineFault unless all chamber sensors show the atmosphere at the end of venting."""
    off = trace.pressure[-1] - plant.supply.atmosphere
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) > zero_tolerance(plant):
        location = f"{CHAMBERS[worst]} sensor"
        found = f"{1e-5 * trace.pressure[-1, worst]:.3f} bar with the chamber vented"
        action = "Set the sensor's zero, or replace it; if all differ alike, correct plant.supply.atmosphere."
        wanted = f"{1e-5 * plant.supply.atmosphere:.3f} bar within {1e-5 * zero_tolerance(plant):.3f}"
        raise MachineFault(location, found, wanted, action)


def _require_vents(traces: Traces, plant: PlantParameters) -> None:
    """Raise MachineFault if a chamber that a ramp has filled does not empty through the vents."""
    for i, joint in enumerate(JOINTS):
        left = traces[f"{joint} ramp"].pressure[-1, 2 * i + 1] - plant.supply.atmosphere
        if left > _LEFT:
            found = f"{1e-5 * left:.2f} bar gauge left in {CHAMBERS[2 * i + 1]} after its valve has shut"
            action = "The vents stay shut, or a throttle is blocked: check both. Mind the air inside."
            raise MachineFault("vents", found, "chambers that empty when the vents are not energised", action)


def _require_supply(traces: Traces, plant: PlantParameters) -> None:
    trace = traces[f"{JOINTS[FOLD_ORDER[0]]} ramp"]
    supply = float(np.median(trace.supply[trace.of_segment(1)]))
    atmosphere = plant.supply.atmosphere
    if supply - atmosphere < _SUPPLY_SHARE * (FAINT - atmosphere):
        raise MachineFault(
            "supply",
            f"{1e-5 * supply:.2f} bar with the regulator set to {1e-5 * FAINT:.2f} bar",
            f"at least {1e-5 * (atmosphere + _SUPPLY_SHARE * (FAINT - atmosphere)):.2f} bar absolute",
            "The supply is too low: check compressor, shut-off and soft-start valve, regulator and hoses.",
        )


def _require_connected(responses: Mapping[int, Array], traces: Traces) -> None:
    """Raise MachineFault unless each valve fills its own chambers, A when it opens upwards."""
    for i in FOLD_ORDER:
        answer = responses[i]
        a, b = answer[2 * i], -answer[2 * i + 1]
        if a > _ANSWER and b > _ANSWER:
            continue
        if a < -_ANSWER and b < -_ANSWER:
            raise MachineFault(
                f"{JOINTS[i]} valve",
                "opens the wrong way: chamber B fills where A should",
                "chamber A fills with a positive opening",
                f"Its hoses A and B, or its signal's polarity, are reversed at the {JOINTS[i]}: swap them. "
                "Or its two chamber sensors are.",
            )
        others = [j for j in range(3) if j != i and np.abs(answer[2 * j : 2 * j + 2]).min() > _ANSWER]
        if others:
            j = others[0]
            found = f"fills the chambers of the {JOINTS[j]}"
            action = f"The valves of {JOINTS[i]} and {JOINTS[j]} are swapped: exchange their cables or hoses."
            raise MachineFault(f"{JOINTS[i]} valve", found, f"those of the {JOINTS[i]}", action)
        raise _unconnected(i, a, b, traces[f"{JOINTS[i]} ramp"])


def _unconnected(i: int, a: float, b: float, trace: MotionTrace) -> MachineFault:
    """Return the fault of a valve whose chambers do not both answer."""
    filled = 2 * i + (0 if a > _ANSWER else 1)
    own = trace.pressure[:, filled]
    if (a > _ANSWER or b > _ANSWER) and own[trace.of_segment(0)][-1] - own.min() > _ANSWER:
        return MachineFault(
            f"{JOINTS[i]} valve",
            f"fills {CHAMBERS[filled]} with its command at zero",
            f"a centre within {MAX_CENTRE}",
            "Its centre is far off: adjust it by the maker's manual, check its signal, or replace the valve.",
        )
    if a > _ANSWER or b > _ANSWER:
        chamber = CHAMBERS[2 * i + (1 if a > _ANSWER else 0)]
        found = f"{chamber} does not fill"
        action = f"The hose of {chamber} is leaking or off, or its sensor does not follow: check both."
        return MachineFault(f"{JOINTS[i]} valve", found, "both chambers fill, each to its side", action)
    highest = float(trace.pressure[:, 2 * i : 2 * i + 2].max())
    found = f"its chambers do not follow its openings (up to {1e-5 * highest:.2f} bar)"
    expected = "chamber A fills with a positive opening, B with a negative one"
    action = "Its spool is stuck or gets no signal: check plug and cable, then clean or replace the valve."
    return MachineFault(f"{JOINTS[i]} valve", found, expected, action)


def stop_depths(trace: MotionTrace, joint: int, side: str, plant: PlantParameters) -> tuple[float, float]:
    """Return how deep `joint` is pressed into its stop at the end of `trace` (rad), and the error."""
    actuator = plant.actuators[joint]
    lower, upper = joint_travel(plant)
    pose = lower.copy()
    pose[joint] = upper[joint] if side == "upper" else lower[joint]
    pressure = trace.pressure[-1, 2 * joint : 2 * joint + 2] - plant.supply.atmosphere
    force = float(pressure[0] * actuator.area_a - pressure[1] * actuator.area_b)
    lever = float(way_per_angle(pose[[joint]], joint, plant)[0])
    torque = force * lever - float(bias_forces(plant.robot, pose, np.zeros(3))[joint])
    torque = max(torque if side == "upper" else -torque, 0.0)
    stiffness = actuator.stop.stiffness * (lever**2 if joint == 1 else 1.0)
    friction = actuator.friction.static * abs(lever) / stiffness
    depth = torque / stiffness
    return depth, float(np.hypot(0.15 * depth, friction))


def _require_travel(joint: int, move: NDArray[np.int64], plant: PlantParameters) -> None:
    """Raise MachineFault unless the encoder of `joint`, and none else, saw its travel in `move` (3,)."""
    way = np.abs(move) * (2 * pi / plant.encoders.counts_per_revolution)
    lower, upper = joint_travel(plant)
    travel = (upper - lower)[joint]
    others = [j for j in range(3) if j != joint and way[j] > 0.5 * min(travel, (upper - lower)[j])]
    if way[joint] < 0.3 * travel and others:
        raise swapped_encoders(joint, others[0], way)
    if way[joint] < 0.3 * travel:
        found = f"moves by {way[joint]:.2f} rad between the stops"
        action = "The joint is blocked, or its encoder's coupling is loose, or the encoder is stuck."
        raise MachineFault(f"{JOINTS[joint]} encoder", found, f"{travel:.2f} rad", action)


def _encoder_values(traces: Traces, plant: PlantParameters) -> tuple[list[ParameterEstimate], list[str]]:
    """Return signs and zeros; raise MachineFault if a scale is wrong."""
    counts = plant.encoders.counts_per_revolution
    per_count = 2 * pi / counts
    lower, upper = joint_travel(plant)
    geometry = _stop_errors(plant)
    signs, errors, ends = [1, 1, 1], [0.0, 0.0, 0.0], np.zeros((3, 2), dtype=np.int64)
    depths = np.zeros((3, 2))
    notes = []
    for i, joint in enumerate(JOINTS):
        up = StopMove(traces[f"{joint} up"], traces[f"{joint} up, pressed"])
        back = StopMove(traces[f"{joint} back"], traces[f"{joint} back, pressed"])
        _require_travel(i, up.way, plant)
        signs[i] = 1 if up.way[i] > 0 else -1
        (low, low_error), (high, high_error) = (
            stop_depths(trace, i, side, plant)
            for trace, side in ((back.pressing, "lower"), (up.pressing, "upper"))
        )
        seen = 0.5 * (abs(up.way[i]) + abs(back.way[i])) * per_count
        travel = upper[i] - lower[i] + low + high
        _require_scale(i, seen, travel, 3.0 * float(np.ptp(geometry[:, i])))
        ends[i], depths[i] = (back.counts[i], up.counts[i]), (low, high)
        mean_geometry = float(np.abs(geometry[:, i].mean()))
        errors[i] = float(np.sqrt((low_error**2 + high_error**2) / 4 + mean_geometry**2 + per_count**2))
        errors[i] = max(errors[i], abs(seen - travel) / 2)
        notes.append(
            f"{joint}: {seen:.4f} rad between the stops, {travel:.4f} rad by the geometry; "
            + ("counts as configured" if signs[i] == plant.encoders.sign[i] else _REVERSED)
        )
    zeros = _zeros(ends, depths, signs, lower, upper, counts)
    values = []
    for i in range(3):
        values.append(ParameterEstimate(f"encoders.sign.{i}", signs[i], 0.0))
        error = errors[i] / per_count
        values.append(ParameterEstimate(f"encoders.zero_count.{i}", zeros[i], error, "counts"))
    return values, notes


_REVERSED = "counts backwards, encoder reversed against the configuration: robot.toml has its sign"


def _zeros(
    ends: NDArray[np.int64], depths: Array, signs: list[int], lower: Array, upper: Array, counts: int
) -> Triple:
    """Return the counts at angle zero: the mean of what both stops say."""
    low = np.array(zero_counts(ends[:, 0], lower - depths[:, 0], signs, counts))
    high = np.array(zero_counts(ends[:, 1], upper + depths[:, 1], signs, counts))
    between = (high - low + counts / 2) % counts - counts / 2
    a, b, c = ((low + between / 2) % counts).tolist()
    return a, b, c


def _require_scale(joint: int, seen: float, travel: float, geometry: float) -> None:
    if abs(seen / travel - 1.0) > _SCALE_TOLERANCE + geometry / travel:
        raise MachineFault(
            f"{JOINTS[joint]} encoder",
            f"{seen:.3f} rad between the stops: wrong scale, {seen / travel:.3f} times the travel",
            f"{travel:.3f} rad, as the geometry has it",
            "Correct plant.encoders.counts_per_revolution, a stop that was moved, or what blocks the way.",
        )


def _stop_errors(plant: PlantParameters) -> Array:
    """Return standard deviations (2, 3) rad of the angles at lower and upper stops, from the lengths'."""
    errors = np.zeros((2, 3))
    robot = plant.robot
    # Only the arm's stops are ends of a stroke; d theta2 / d length by the lever.
    for k, extension in enumerate((plant.right_arm.lower, plant.right_arm.upper)):
        pose = np.array(joint_travel(plant)[k])
        lever = float(way_per_angle(pose[[1]], 1, plant)[0])
        length = robot.l56 + extension
        along = np.array(
            [
                1.0,
                -(robot.l62 + robot.l23 * np.cos(pose[1])) / length,
                -(robot.l62 + robot.l23 * np.cos(pose[1])) / length,
                -(robot.l23 + robot.l62 * np.cos(pose[1])) / length,
            ]
        )
        errors[k, 1] = _LENGTH * _UNIFORM * float(np.linalg.norm(along)) / abs(lever)
    return errors


_BELOW, _ABOVE = 0.02, 0.08
"""Openings on this side of the rough edge and beyond it."""
_EDGE_RAMP, _REST = 1.6, 0.8
"""Durations of the ramp over an edge and of the rest after it (s)."""


def _estimate_valves(traces: Traces, known: RobotEstimate) -> StepResult:
    """Return centre and dead band of each valve."""
    values: list[ParameterEstimate] = []
    for i, key in enumerate(ACTUATOR_KEYS):
        fit = fit_air((traces[f"{JOINTS[i]} lower"], traces[f"{JOINTS[i]} upper"]), known, i)
        for name, most in (("valve.centre", MAX_CENTRE), ("valve.dead_band", MAX_BAND)):
            k = NAMES.index(name)
            value, error = float(fit.values[k]), float(fit.error[k])
            if abs(value) > most:
                found = f"{name.partition('.')[2].replace('_', ' ')} {value:+.3f}"
                action = "Adjust the valve's centre by its maker's manual, or replace the valve."
                raise MachineFault(f"{JOINTS[i]} valve", found, f"at most {most}", action)
            values.append(ParameterEstimate(f"{key}.{name}", value, error))
    return StepResult(tuple(values))


def _edge_ramp(machine: CommissionedMachine, known: RobotEstimate, joint: int, side: Side) -> MotionTrace:
    """Return the ramp of `joint`'s valve towards `side`, at whose stop it stands."""

    def at(opening: float) -> Triple:
        return openings(known, joint, beyond(known, joint, side, opening))

    rest = openings(known, joint, centres(known)[joint])
    return run_slowly(
        machine,
        known,
        (
            Segment(_REST, at(-_BELOW)),
            Segment(_EDGE_RAMP, at(-_BELOW), at(_ABOVE)),
            Segment(_EDGE_RAMP, at(_ABOVE), at(-_BELOW)),
            Segment(_REST, rest),
        ),
        f"{JOINTS[joint]} valve ramped at its {side} stop",
    )


VALVES = CommissioningStep(
    "valves",
    "Centres and dead bands of the valves",
    "openings up to 0.15 at 3 bar absolute with open vents, joints at their stops",
    partial(at_both_stops, trace=_edge_ramp),
    _estimate_valves,
)
"""Step 2."""
