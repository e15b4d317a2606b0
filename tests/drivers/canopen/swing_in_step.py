"""A whole bench in step: the cycle of the real-time loop, a driver, and the plant behind it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from bench.base.lifecycle import Phase, Request
from bench.config import Configuration
from bench.control.settings import build_controller
from bench.loop.loop import Cycle, CycleArray, Cycles
from bench.simulation.safety import Loads, loads_of, reset_peaks
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base import Driver, DriverError
from drivers.canopen.settings import CanopenSettings
from sim.driver import SimDriver, hanging_pose
from sim.sensors import note_truth
from tests.drivers.canopen.in_step import SETTINGS, DriverInStep, Wire, nodes_plan

LONGEST = 20_000
"""Ticks until something awaited happens."""
_AT_ADDRESS, _AT_REST = 800, 1500
"""Ticks."""


class NotReached(RuntimeError):
    """The robot did not come to where it was awaited."""


class SwingBench:
    """A driver with the shipped control, from power-up in READY on."""

    def __init__(self, configuration: Configuration, driver: Driver, state: np.ndarray[Any, Any]) -> None:
        """`state` (PLANT_STATE) is the plant's behind `driver`."""
        c = configuration
        profile = load_profile(find_profile(c.swing.profile))
        self.driver, self.state = driver, state
        self.plant, self.period = c.plant, c.plant.tick
        self.kept = CycleArray(4 * LONGEST)
        parameters = build_controller(c.plant, profile, c.control, c.envelope, c.estimator)
        self.air_planned = bool(parameters.profile["air_planned"][0])
        self.cycle = Cycle(
            driver, parameters, self.kept, name="in step", note_truth=partial(note_truth, state)
        )
        self.tick = 0
        driver.open()

    def run(self, holds: Callable[[], bool], after: Callable[[], None] = lambda: None) -> None:
        """Run ticks until something holds, `after` behind each.

        Raises:
            NotReached: it does not within LONGEST ticks.
        """
        for _ in range(LONGEST):
            if holds():
                return
            with suppress(DriverError):  # what the loop process does too: it goes on, passive
                self.cycle.run_tick(self.tick * self.period)
            self.tick += 1
            after()
        raise NotReached(f"still {self.cycle.phase.name} after {LONGEST} ticks")

    def ask(self, request: Request) -> None:
        """Put a request and run until it is answered."""
        self.cycle.request(request)
        self.run(lambda: int(self.cycle.state.control["request"][0]) == 0)

    def reach(self, phase: Phase) -> None:
        """Run to the first tick of `phase`, a ball on the tee once the robot is at its address."""
        self.run(lambda: self.tick == 300)
        if phase is Phase.STANDING:
            return
        self.ask(Request.ARM)
        self.run(self.lasting(lambda: self.cycle.phase is Phase.HOLD, _AT_ADDRESS))
        self.state["ball_present"], self.state["struck"] = True, False
        self.run(self.has_air)
        if phase is not Phase.HOLD:
            self.ask(Request.SWING)
            self.run(lambda: self.cycle.phase is phase)

    def has_air(self) -> bool:
        """Whether the chambers are as planned, or no pressures are."""
        return not self.air_planned or bool(self.cycle.state.control["address_air"]["ready"][0])

    def rests(self) -> bool:
        """Whether the robot stands, as plant and controller see it."""
        return bool(np.all(np.abs(self.state["speed"][0]) < 0.2)) and self.cycle.phase is Phase.STANDING

    def come_to_rest(self, after: Callable[[], None] = lambda: None) -> None:
        """Run until the robot has stood for a while, or LONGEST ticks: then it holds on."""
        with suppress(NotReached):
            self.run(self.lasting(self.rests, _AT_REST), after)

    def lasting(self, holds: Callable[[], bool], ticks: int) -> Callable[[], bool]:
        """Return a condition that is true once `holds` has been true for more than `ticks` ticks."""
        lasted = [0]

        def lasts() -> bool:
            lasted[0] = lasted[0] + 1 if holds() else 0
            return lasted[0] > ticks

        return lasts

    def swing(self) -> Cycles:
        """Swing once at a ball, return to the address, and return the record from the request on."""
        self.reach(Phase.HOLD)
        first = len(self.kept.cycles)
        self.ask(Request.SWING)
        self.run(lambda: self.cycle.phase is Phase.RETURN or self.cycle.phase is Phase.STANDING)
        self.run(self.lasting(lambda: self.cycle.phase in (Phase.HOLD, Phase.STANDING), _AT_ADDRESS))
        return self.kept.cycles[first:]

    def reset_peaks(self) -> None:
        """Reset the loads."""
        reset_peaks(self.state)

    @property
    def loads(self) -> Loads:
        """Loads since `reset_peaks`."""
        return loads_of(self.state, self.plant)


def on_canopen(
    configuration: Configuration, settings: CanopenSettings = SETTINGS
) -> tuple[SwingBench, DriverInStep, Wire]:
    """Return a bench over the bus, timed as in real time: the plant's tick, the SYNC, then the answers."""
    wire = Wire(replace(nodes_plan(configuration.plant), angle=tuple(hanging_pose(configuration.plant))))
    wire.lead, wire.delay = 0.3e-3, 0.1e-3
    driver = DriverInStep(wire, settings)
    return SwingBench(configuration, driver, wire.nodes.plant.state), driver, wire


def on_plant(configuration: Configuration) -> SwingBench:
    """Return the same bench on the `sim` driver."""
    driver = SimDriver(configuration.plant)
    return SwingBench(configuration, driver, driver.plant_state)
