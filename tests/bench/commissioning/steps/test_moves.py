"""Moves to the stops: low supply pressure until each joint has answered, few turns of the regulator."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from bench.commissioning.machine.commissioning_step import (
    FOLD_ORDER,
    MOVING,
    PRESSING,
    MachineFault,
    RobotEstimate,
    fold,
)
from bench.commissioning.machine.driver_machine import SimulatedMachine
from bench.commissioning.machine.inputs import turned_once
from bench.commissioning.machine.machine import MotionBounds, MotionTrace, Segment
from bench.commissioning.steps.wiring import FAINT, WIRING
from drivers.base import CHAMBERS, JOINTS
from sim.driver import joint_travel
from sim.plant import PlantParameters

PLANT = PlantParameters()
DOWN = [f"{JOINTS[joint]} to its lower stop" for joint in FOLD_ORDER]
PRESSED = [f"{JOINTS[joint]} pressed to its lower stop" for joint in FOLD_ORDER]


class Scripted:
    """A machine whose joints go from angles `start` by as many of the `ways` (rad) as its motions need."""

    def __init__(self, **ways: tuple[float, ...]) -> None:
        lower, upper = joint_travel(PLANT)
        self.angle, self.stops = (lower + upper) / 2, (lower, upper)
        self.ways = {joint: list(way) for joint, way in ways.items()}
        self.done: list[tuple[float, str]] = []
        """Supply pressure (Pa) and name of each motion."""
        self.turns: list[float] = []
        self.set_supply = turned_once(self.turns.append)

    def run(self, segments: tuple[Segment, ...], bounds: MotionBounds, doing: str = "") -> MotionTrace:
        self.done.append((self.turns[-1], doing))
        joint = JOINTS.index(doing.split(maxsplit=1)[0])
        way = np.zeros(3)
        if ways := self.ways.get(JOINTS[joint]):
            way[joint] = ways.pop(0)
        else:
            way[joint] = (self.stops["upper" in doing] - self.angle)[joint]
        per_count = 2 * pi / PLANT.encoders.counts_per_revolution * np.array(PLANT.encoders.sign)
        first = np.round(self.angle / per_count + PLANT.encoders.zero_count).astype(np.int64)
        count = np.round(np.outer(np.linspace(0.0, 1.0, 9), way / per_count)).astype(np.int64)
        self.angle = self.angle + way
        shown, zeros = np.full((9, len(CHAMBERS)), PRESSING), np.zeros(9)
        ended = (True,) * len(segments)
        return MotionTrace(
            zeros, first, count, shown, zeros, np.zeros((9, 3)), zeros > 0, zeros.astype(int), None, ended
        )

    def vent(self, duration: float = 40.0) -> MotionTrace:
        raise AssertionError(duration)


def test_fold_turns_supply_up_once_after_each_joint_has_answered() -> None:
    machine = Scripted()
    fold(machine, RobotEstimate(PLANT))
    assert machine.turns == [MOVING, PRESSING]
    assert machine.done == [*((MOVING, name) for name in DOWN), *((PRESSING, name) for name in PRESSED)]


def test_fold_presses_joint_that_friction_holds_before_next_moves() -> None:
    machine = Scripted(wrist=(-0.2,))
    fold(machine, RobotEstimate(PLANT))
    assert machine.turns == [MOVING, PRESSING, MOVING, PRESSING]
    first = [(MOVING, DOWN[0]), (PRESSING, PRESSED[0]), (MOVING, DOWN[1]), (MOVING, DOWN[2])]
    assert machine.done[:4] == first


@pytest.mark.parametrize("joint", JOINTS)
def test_fold_joint_at_stop_answers_by_upward_motion(joint: str) -> None:
    machine = Scripted()
    machine.angle[JOINTS.index(joint)] = machine.stops[0][JOINTS.index(joint)]
    fold(machine, RobotEstimate(PLANT))
    assert machine.turns == [MOVING, PRESSING]
    assert (MOVING, f"{joint} to its upper stop") in machine.done


@pytest.mark.parametrize("joint", JOINTS)
def test_fold_joint_that_moves_wrong_way_is_fault_at_low_pressure(joint: str) -> None:
    machine = Scripted(**{joint: (0.2,)})
    with pytest.raises(MachineFault, match=f"{joint}.*0.20 rad away"):
        fold(machine, RobotEstimate(PLANT))
    assert machine.turns == [MOVING]


@pytest.mark.slow
def test_measure_wiring_turns_regulator_five_times(monkeypatch: pytest.MonkeyPatch) -> None:
    turns = list[float]()
    with SimulatedMachine(PLANT, PLANT) as machine:
        real, names = machine.set_supply, list[str]()

        def turn(pressure: float) -> None:
            turns.append(pressure)
            names.append(f"{pressure:g} Pa")
            real(pressure)

        monkeypatch.setattr(machine, "set_supply", turned_once(turn))
        run = machine.run

        def noted(segments: tuple[Segment, ...], bounds: MotionBounds, doing: str = "") -> MotionTrace:
            names.append(doing)
            return run(segments, bounds, doing)

        monkeypatch.setattr(machine, "run", noted)
        known = RobotEstimate(PLANT)
        WIRING.estimate(WIRING.measure(machine, known), known)
    assert turns == [FAINT, MOVING, PRESSING, MOVING, PRESSING]
    answered = names[: len(names) - names[::-1].index(f"{PRESSING:g} Pa")]
    for joint in JOINTS:
        assert f"{joint} to its upper stop" in answered
