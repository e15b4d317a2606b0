"""A step of commissioning: its moves, what its traces say, the faults it may find, and the robot as known."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.commissioning.machine.machine import (
    Array,
    CommissionedMachine,
    MotionBounds,
    MotionTrace,
    Segment,
    Until,
)
from bench.config import Configuration
from bench.control.measured_plant import value_at, with_values
from bench.simulation.safety import Loads
from bench.simulation.simulated_bench import Bench, Series, SeriesSwing
from bench.swing.profile import Profile
from drivers.base import CHAMBERS, JOINTS, Triple
from sim.driver import joint_travel
from sim.impact import Delivery
from sim.kane import mass_matrix
from sim.plant import ACTUATOR_KEYS, PlantParameters

Side = Literal["lower", "upper"]
SIDES: tuple[Side, Side] = ("upper", "lower")

FOLD_ORDER = (2, 1, 0)
"""Joints in the order in which they go to their lower stops: first the club is folded off the ground."""
MOVING = 3.0e5
"""Supply pressure until each joint has answered: a person may have been at the robot before (Pa absolute)."""
PRESSING = 4.5e5
"""Supply pressure of later motions, and while a joint is pressed against an end stop (Pa absolute)."""
PRESSED = 3.0e5
"""Pressure of the driving chamber at which even a joint of high friction is at its stop, Pa absolute."""
PARKING = 0.03
"""Opening beyond the edge that holds a parked joint at its lower stop."""
_LADDER = (0.03, 0.05, 0.08, 0.12, 0.16)
"""Openings beyond the edge, one after the other until the joint does not move any more."""
_RESTED, _LEVEL = 0.8, 6.0
"""Time without motion that ends a level, and its max duration (s)."""
_FILLING = 15.0
"""Max time for the driving chamber to fill, s."""
_OWN_SHARE = 0.2
"""Share of another joint's way below which an encoder does not follow its own."""
_JUMP = 100.0
"""Speed beyond which a count has jumped (rad/s)."""
_ANSWER = 0.05
"""Min way by which a joint answers (rad)."""
_AT_STOP = 0.02
"""Max distance from its stop of a joint that friction does not hold (rad)."""
_CUSHION_SHARE = 0.5
"""Fraction of an absorber's rated energy that a joint has at the speed bound."""


class ParameterEstimate(NamedTuple):
    """A value that a step found."""

    key: str
    """Dotted key below [plant]; in a list with the index: encoders.sign.0."""
    value: float
    error: float
    """Standard error."""
    unit: str = ""
    step: str = ""
    """Name of the step that found it."""


class RobotEstimate:
    """The configured robot with the values found so far."""

    def __init__(self, nominal: PlantParameters, found: Iterable[ParameterEstimate] = ()) -> None:
        """Begin with `nominal` and values `found` before."""
        self.nominal = nominal
        self.found: dict[str, ParameterEstimate] = {}
        self.plant = nominal
        """The robot as far as it is known."""
        self.add(found)

    def add(self, values: Iterable[ParameterEstimate]) -> None:
        """Add `values`; one that was found before is replaced."""
        self.found |= {value.key: value for value in values}
        self.plant = with_values(self.nominal, {key: found.value for key, found in self.found.items()})

    def value(self, key: str) -> float:
        """Return the value of `key`, found or configured."""
        return float(value_at(self.plant, key))

    def error(self, key: str, otherwise: float) -> float:
        """Return the standard error of `key`; `otherwise` if it was not found."""
        found = self.found.get(key)
        return otherwise if found is None else found.error


class StopMove(NamedTuple):
    """A joint's move to one of its stops, and its being pressed there."""

    moving: MotionTrace
    pressing: MotionTrace

    @property
    def way(self) -> np.ndarray:
        """Ways of all joints (3,) in counts."""
        return np.asarray(self.moving.count[-1] + self.pressing.count[-1])

    @property
    def counts(self) -> np.ndarray:
        """Counts (3,) at its end, not wrapped."""
        return np.asarray(self.pressing.first_count + self.pressing.count[-1])


def joint_angles(trace: MotionTrace, plant: PlantParameters) -> Array:
    """Return the joint angles (n, 3) rad in `trace` by the encoders of `plant`."""
    return count_angles(trace.first_count + trace.count, plant)


def count_angles(count: NDArray[np.int64], plant: PlantParameters) -> Array:
    """Return the joint angles (n, 3) rad at encoder counts (n, 3), by the encoders of `plant`."""
    encoders = plant.encoders
    per_count = 2 * pi / encoders.counts_per_revolution
    lower, upper = joint_travel(plant)
    turned = np.unwrap(count, period=encoders.counts_per_revolution, axis=0)
    angle = (turned + 0.5 - np.array(encoders.zero_count)) * (np.array(encoders.sign) * per_count)
    turns = np.round((angle[0] - (lower + upper) / 2) / (2 * pi))
    return np.asarray(angle - 2 * pi * turns)


def slow_bounds(plant: PlantParameters, pressure: float) -> MotionBounds:
    """Return bounds at which no absorber takes more than half its rated energy, below `pressure` (Pa)."""
    lower, upper = joint_travel(plant)
    inertia = np.diag(mass_matrix(plant.robot, (lower + upper) / 2))
    energy = np.array([actuator.stop.energy for actuator in plant.actuators])
    a, b, c = np.sqrt(2.0 * _CUSHION_SHARE * energy / (1.3 * inertia)).tolist()
    x, y, z = (1.3 * (upper - lower)).tolist()
    return MotionBounds((a, b, c), (x, y, z), pressure)


def edges(known: RobotEstimate, actuator: int) -> tuple[float, float]:
    """Return the openings at which the valve's flow to B and to A begins."""
    key = f"{ACTUATOR_KEYS[actuator]}.valve"
    centre, band = known.value(f"{key}.centre"), known.value(f"{key}.dead_band")
    return centre - band, centre + band


def centres(known: RobotEstimate) -> Triple:
    """Return the commands at which all spools are centred."""
    a, b, c = (known.value(f"{key}.valve.centre") for key in ACTUATOR_KEYS)
    return a, b, c


def beyond(known: RobotEstimate, actuator: int, side: Side, opening: float) -> float:
    """Return the command that opens valve `actuator` by `opening` beyond its edge towards `side`."""
    lower, upper = edges(known, actuator)
    return upper + opening if side == "upper" else lower - opening


def openings(known: RobotEstimate, joint: int, command: float, parked: Iterable[int] = FOLD_ORDER) -> Triple:
    """Return commands that hold joints `parked` at their lower stops and centre the other spools.

    `joint` has its `command`.
    """
    values = list(centres(known))
    for i in parked:
        values[i] = beyond(known, i, "lower", PARKING)
    values[joint] = command
    a, b, c = values
    return a, b, c


def towards_stop(
    machine: CommissionedMachine, known: RobotEstimate, joint: int, side: Side, parked: Iterable[int] = ()
) -> MotionTrace:
    """Move `joint` towards its stop at `side`, joints `parked` held at their lower ones.

    The supply stays as it is: at a low one, friction may hold the joint before its stop.

    Raises:
        MachineFault: a bound was passed.
    """
    rested = Until("rested", joint, _RESTED)
    ladder = tuple(
        Segment(_LEVEL, _towards(known, joint, side, opening, parked), until=rested) for opening in _LADDER
    )
    return _moved(machine, known, joint, ladder, f"{JOINTS[joint]} to its {side} stop")


def pressed_to_stop(
    machine: CommissionedMachine, known: RobotEstimate, joint: int, side: Side, parked: Iterable[int] = ()
) -> MotionTrace:
    """Press `joint` to its stop at `side` by a supply of `PRESSING`, joints `parked` held at lower ones.

    Raises:
        MachineFault: a bound was passed, or the driving chamber does not fill.
    """
    chamber = 2 * joint + (0 if side == "upper" else 1)
    valve = _towards(known, joint, side, _LADDER[-1], parked)
    fill = Segment(_FILLING, valve, until=Until("above", chamber, PRESSED))
    rest = Segment(_LEVEL, valve, until=Until("rested", joint, _RESTED))
    machine.set_supply(PRESSING)
    pressing = _moved(machine, known, joint, (fill, rest), f"{JOINTS[joint]} pressed to its {side} stop")
    if not pressing.ended[0]:
        reached = pressing.pressure[-1, chamber]
        raise MachineFault(
            f"{JOINTS[joint]}, {CHAMBERS[chamber]}",
            f"fills to {1e-5 * reached:.2f} bar in {_FILLING:g} s at a supply of {1e-5 * PRESSING:.1f} bar",
            f"at least {1e-5 * PRESSED:.1f} bar",
            "Look for a leaking hose or fitting, a vent that stays open, or a valve that opens too little.",
        )
    return pressing


def _towards(known: RobotEstimate, joint: int, side: Side, opening: float, parked: Iterable[int]) -> Triple:
    """Return commands that open the valve of `joint` towards `side`; joints `parked` are held."""
    return openings(known, joint, beyond(known, joint, side, opening), (i for i in parked if i != joint))


def _moved(
    machine: CommissionedMachine, known: RobotEstimate, joint: int, segments: tuple[Segment, ...], doing: str
) -> MotionTrace:
    """Return the trace of `segments`, which move `joint`.

    Raises:
        MachineFault: a bound was passed.
    """
    trace = machine.run(segments, slow_bounds(known.plant, 1.2 * PRESSING), doing)
    _require_own_encoder(trace, joint, known.plant)
    require_within(trace, doing)
    return trace


def move_to_stop(
    machine: CommissionedMachine, known: RobotEstimate, joint: int, side: Side, parked: Iterable[int] = ()
) -> StopMove:
    """Move `joint` to its stop at `side` and press it there, at a supply of `PRESSING`.

    Raises:
        MachineFault: a bound was passed, or the driving chamber does not fill.
    """
    machine.set_supply(PRESSING)
    moving = towards_stop(machine, known, joint, side, parked)
    return StopMove(moving, pressed_to_stop(machine, known, joint, side, parked))


def fold(machine: CommissionedMachine, known: RobotEstimate) -> None:
    """Move all joints of the vented robot to their lower stops, the club first, and press them there.

    The guard may have been open: each joint answers at a supply of `MOVING`, unless friction holds it, before
    the supply is turned up.

    Raises:
        MachineFault: a bound was passed, a joint moves the wrong way, or a driving chamber does not fill.
    """
    moved = [
        _move_gently(machine, known, joint, "lower", FOLD_ORDER[:n]) for n, joint in enumerate(FOLD_ORDER)
    ]
    for joint in (joint for joint, answered in zip(FOLD_ORDER, moved, strict=True) if not answered):
        for side in SIDES:
            _move_gently(machine, known, joint, side, FOLD_ORDER)
    for joint in FOLD_ORDER:
        pressed_to_stop(machine, known, joint, "lower", FOLD_ORDER)


def _move_gently(
    machine: CommissionedMachine, known: RobotEstimate, joint: int, side: Side, parked: Iterable[int]
) -> bool:
    """Move `joint` to its stop at `side` at a supply of `MOVING`; press it there if friction holds it.

    Return whether it moved.
    """
    machine.set_supply(MOVING)
    trace = towards_stop(machine, known, joint, side, parked)
    moved = _require_direction(trace, joint, side, known)
    stop = joint_travel(known.plant)[SIDES[::-1].index(side)][joint]
    if abs(joint_angles(trace, known.plant)[-1, joint] - stop) > _AT_STOP:
        pressed_to_stop(machine, known, joint, side, parked)
        machine.set_supply(MOVING)
    return moved


def _require_direction(trace: MotionTrace, joint: int, side: Side, known: RobotEstimate) -> bool:
    """Return whether `joint` moved in `trace`; raise MachineFault if it did not move towards `side`."""
    angle = joint_angles(trace, known.plant)[:, joint]
    way = float(angle[-1] - angle[0]) * (1.0 if side == "upper" else -1.0)
    if way < -_ANSWER:
        found = f"turns by {-way:.2f} rad away from its {side} stop, by its encoder"
        action = f"Valve, hoses or encoder of the {JOINTS[joint]} are reversed since step 1: check them."
        raise MachineFault(JOINTS[joint], found, "a motion towards it", action)
    return way > _ANSWER


def at_both_stops(
    machine: CommissionedMachine,
    known: RobotEstimate,
    trace: Callable[[CommissionedMachine, RobotEstimate, int, Side], MotionTrace],
) -> dict[str, MotionTrace]:
    """Return a `trace` of each joint at either stop by name, at a supply of `MOVING`.

    The machine is vented before and afterwards.
    """
    machine.vent()
    fold(machine, known)
    machine.set_supply(MOVING)
    traces: dict[str, MotionTrace] = {}
    for joint in FOLD_ORDER[::-1]:
        traces[f"{JOINTS[joint]} lower"] = trace(machine, known, joint, "lower")
        _move_gently(machine, known, joint, "upper", FOLD_ORDER)
        traces[f"{JOINTS[joint]} upper"] = trace(machine, known, joint, "upper")
        _move_gently(machine, known, joint, "lower", FOLD_ORDER)
    machine.vent()
    return traces


def _require_own_encoder(trace: MotionTrace, joint: int, plant: PlantParameters) -> None:
    """Raise MachineFault if a bound ended `trace` by an encoder of another joint or of a wrong scale."""
    if not trace.tripped:
        return
    way = np.abs(trace.count[-1] * (2 * np.pi / plant.encoders.counts_per_revolution))
    lower, upper = joint_travel(plant)
    jumps = np.abs(np.diff(trace.count, axis=0)).max(axis=0, initial=0)
    for name, jump in zip(JOINTS, jumps.tolist(), strict=True):
        if jump > _JUMP * plant.tick * plant.encoders.counts_per_revolution / (2 * np.pi):
            found = f"its count jumps by {jump}: wrong scale, or broken"
            expected = f"counts up to {plant.encoders.counts_per_revolution} that change evenly"
            action = "Correct plant.encoders.counts_per_revolution, or check cable, shield and encoder."
            raise MachineFault(f"{name} encoder", found, expected, action)
    name, seen = JOINTS[joint], int(np.argmax(way))
    if seen != joint and way[joint] < _OWN_SHARE * way[seen]:
        raise swapped_encoders(joint, seen, way)
    if trace.tripped.way_of == joint:
        found = f"turns by {way[joint]:.2f} rad and is not at a stop: wrong scale, or no stop"
        expected = f"at most {(upper - lower)[joint]:.2f} rad between the stops"
        action = "Correct plant.encoders.counts_per_revolution, or fasten its coupling, or fit the stop."
        raise MachineFault(f"{name} encoder", found, expected, action)


def swapped_encoders(joint: int, seen: int, way: np.ndarray) -> MachineFault:
    """Return that the encoder of joint `seen` follows `joint`; `way` (3,) rad by the encoders."""
    name, other = JOINTS[joint], JOINTS[seen]
    found = f"turns by {way[joint]:.2f} rad when the {name} moves, that of the {other} by {way[seen]:.2f} rad"
    action = f"The encoders of {name} and {other} are swapped: exchange their cables."
    return MachineFault(f"{name} encoder", found, f"the encoder of the {name} follows it", action)


def require_within(trace: MotionTrace, doing: str) -> None:
    """Raise MachineFault if a bound ended `trace`."""
    if not trace.tripped:
        return
    if trace.tripped.way_of is not None:
        action = (
            "An encoder's scale is wrong (plant.encoders.counts_per_revolution), or its "
            "coupling is loose, or a stop is missing."
        )
    else:
        action = (
            "Look for a valve that opens too far, an encoder that jumps, or a supply that is not turned down."
        )
    raise MachineFault(doing, trace.tripped.text, "a slow motion between the stops", action)


def run_slowly(
    machine: CommissionedMachine,
    known: RobotEstimate,
    segments: tuple[Segment, ...],
    doing: str,
    pressure: float = 1.2 * PRESSING,
) -> MotionTrace:
    """Return the trace of `segments` within slow bounds below `pressure` (Pa).

    Raises:
        MachineFault: a bound was passed, `doing` that.
    """
    trace = machine.run(segments, slow_bounds(known.plant, pressure), doing)
    require_within(trace, doing)
    return trace


class MachineFault(Refused):
    """A step found the machine wrong; it was left passive. Exits with REFUSED."""


class SwingStopped(MachineFault):
    """A swing that something stopped."""


class PredictionFails(MachineFault):
    """The model of the robot as measured does not do the step; the robot itself has not moved."""


class PredictionStopped(PredictionFails, SwingStopped):
    """A swing that something stopped in the prediction."""


Mark = tuple[float, float]
"""Position of the ball's mark relative to the face centre: towards the toe, upwards (mm)."""
_READ = 0.5
"""mm to which a person reads a mark."""


def read_mark(delivery: Delivery | None) -> Mark | None:
    """Return the mark of a simulated `delivery` as a person reads it; None without one."""
    if delivery is None:
        return None
    toe, high = (_READ * round(1e3 * at / _READ) for at in (delivery.strike_x, delivery.strike_y))
    return toe, high


class SwingSeries(Protocol):
    """Swings at a ball, one after the other, from the same address."""

    def swing(self, profile: Profile, *, ball: bool = True) -> SeriesSwing:
        """Swing `profile`, at a teed ball or without one, and come back to the address, also after a stop.

        Raises:
            Refused: the robot does not come back.
        """

    def loads(self) -> Loads | None:
        """Return the loads since the series was armed; None where nothing measures them."""

    def face_mark(self, swing: SeriesSwing) -> Mark | None:
        """Return the mark that the ball of the last `swing` left on the face; None where it is not read."""


Arm = Callable[[Bench], SwingSeries]
"""Arms a bench, whose model is the robot as it is known; raises Refused if it does not reach its address."""


class SimulatedSeries(Series):
    """Swings of the simulated plant, whose marks on the face are read."""

    def face_mark(self, swing: SeriesSwing) -> Mark | None:
        """Return the mark that the ball of `swing` left."""
        return read_mark(swing.delivery)


SWING_FILE, LEARNED_FILE = "swing.toml", "learned.toml"
"""Files of the profile at 100 % speed, without and with its learned correction."""

Traces = Mapping[str, MotionTrace]
"""Traces of a step by the name of the motion."""


class StepResult(NamedTuple):
    """Result of a step."""

    values: tuple[ParameterEstimate, ...]
    notes: tuple[str, ...] = ()
    """Findings for the report other than values."""


@dataclass(frozen=True)
class NamedStep:
    """A step of commissioning."""

    name: str
    """Short name, part of file names."""
    title: str
    """Title of the findings, for the report."""
    bounds_text: str
    """How the energy is bounded, for the report."""


@dataclass(frozen=True)
class SwingingStep(NamedStep):
    """A step that swings the robot as it was measured."""

    swing: Callable[[Arm, Configuration, Path, Callable[[str], None]], StepResult]
    """Swings the robot as measured, leaves files in the folder, and reports the present part.

    Raises MachineFault if it does not swing as a right one does, Refused if it does not reach its address.
    """


@dataclass(frozen=True)
class CommissioningStep(NamedStep):
    """A measuring step; measuring and estimating are separate: a stored trace can be estimated again."""

    measure: Callable[[CommissionedMachine, RobotEstimate], Traces]
    """Moves the robot, which is vented afterwards.

    Raises MachineFault if the machine does not behave as a fault-free one, Refused if an interlock ended it.
    """
    estimate: Callable[[Traces, RobotEstimate], StepResult]
    """Pure function of the traces; raises MachineFault if they say that the machine is wrong."""
