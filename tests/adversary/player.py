"""A story played on the lock-step bench, every tick of it judged."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.base.configuration_files import find_configuration
from bench.base.lifecycle import Answer, Phase, Refusal, Request, State
from bench.config import load_configuration
from bench.control.settings import build_controller
from bench.control.step_records import ControlParameters, new_control_state
from bench.simulation.lockstep import Lockstep
from bench.simulation.safety import Loads, loads_of
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.driver import hanging_pose, joint_travel
from sim.faults import Fault, new_faults, own_records, revive
from sim.plant import Plant, build_plant
from tests.adversary.properties import Judge
from tests.adversary.story import Setup, Step, Story, fault_of
from tests.benchmarks.healthy_swings import counting

INPUTS = ("emergency_stop_clear", "guard_closed")
PERMITS = ("lease_held", "support_ready", "supervisor_alive")
_PRESS = 40
"""Ticks for which a button is pressed."""
_SWINGS_ASKED, _BETWEEN = 300, 10
"""Max swing requests while the chamber pressures settle, and ticks between two requests."""
_LONGEST_RECOVERY = 240_000
_CHUNK = 500
"""Ticks between two looks."""


@lru_cache(maxsize=64)
def _built(setup: Setup) -> tuple[Plant, ControlParameters]:
    c = load_configuration(find_configuration(Path(setup.configuration)))
    plant = replace(c.plant, pressure_sensors=setup.sensors)
    if setup.incremental:
        plant = counting(plant)
    lifecycle = replace(
        c.lifecycle,
        local_reset=setup.local_reset,
        hold_between_swings=setup.series,
        warning_time=setup.warning_time,
        armed_timeout=setup.armed_timeout,
    )
    homing = replace(c.homing, method="index" if setup.incremental else "absolute")
    envelope = c.envelope.with_model_check("always" if setup.check else "off")
    profile = load_profile(find_profile(c.swing.profile))
    parameters = build_controller(plant, profile, c.control, envelope, c.estimator, lifecycle, homing)
    return build_plant(plant), parameters


class Player:
    """A bench that is switched on, to which the steps of a story are done."""

    def __init__(self, setup: Setup) -> None:
        """Switch the bench of `setup` on."""
        self.setup = setup
        self.healthy, parameters = _built(replace(setup, turned=(0.0, 0.0, 0.0), seed=1))
        self.hanging = hanging_pose(self.healthy.parameters)
        start = np.clip(self.hanging + setup.turned, *joint_travel(self.healthy.parameters))
        self.bench = Lockstep(own_records(self.healthy), parameters, start)
        self.bench.state = new_control_state(State.STARTING)
        self.control: NDArray[Any] = np.asarray(self.bench.state.control)
        for name in PERMITS:
            self.control[name] = True
        self.faults: tuple[Fault, ...] = ()
        self.ever: list[Fault] = []
        """Every fault that there was."""
        self.steps: list[Step] = []
        self.accepted = self.asked = self.number = 0
        self.judge = Judge(setup, parameters)
        self._break(())
        for _ in range(2):
            self._advance(10)

    # What is seen ---------------------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """State of the bench."""
        return State(int(self.control["state"][0]))

    @property
    def phase(self) -> Phase:
        """Phase of the bench."""
        return Phase(int(self.control["phase"][0]))

    @property
    def broken(self) -> list[str]:
        """Properties violated so far."""
        return self.judge.broken

    @property
    def loads(self) -> Loads:
        """Loads on the robot since power-up."""
        return loads_of(self.bench.plant_state, self.healthy.parameters)

    # What is done ---------------------------------------------------------------------------------------

    def do(self, step: Step) -> None:
        """Do one step of a story."""
        verb, what, how = step
        self.steps.append(step)
        match verb:
            case "wait":
                self._advance(int(what))
            case "ask":
                self._ask_as_clients_do(int(Request[what.upper()]) if isinstance(what, str) else int(what))
            case "input":
                self.bench.plant_state[what] = bool(how)
                self._advance(1)
            case "permit":
                self.control[what] = bool(how)
                self._advance(1)
            case "press":
                self._press()
            case "break":
                self.ever.append(fault_of(what))
                self._break((*self.faults, fault_of(what)))
            case "mend":
                self._break(())
            case _:
                raise ValueError(f"no such step: {verb}")

    def recover(self) -> None:
        """Remove all faults, then act as an operator may until the bench is READY."""
        self._break(())
        for name in INPUTS:
            self.bench.plant_state[name] = True
        for name in PERMITS:
            self.control[name] = True
        self._advance(100)
        begin, failures = self.bench.tick, 0
        while self.bench.tick - begin < _LONGEST_RECOVERY:
            match self.state:
                case State.READY if self.phase is Phase.STANDING:
                    return
                case State.ESTOP | State.FAULT if self.bench.plant_state["guard_locked"][0]:
                    self._press()
                    self._ask(Request.RESET)
                    if self.control["refusal"][0] == Refusal.LOCK:
                        self._ask(Request.ACCESS)  # a lock that read wrong has to be seen released
                case State.ESTOP | State.FAULT | State.ACCESS:
                    self._press()
                    self._ask(Request.SECURE)
                case State.SAFE if failures == 0 or self.control["vented"][0]:
                    if failures:
                        self._move_by_hand()
                    accepted = self.accepted
                    self._ask(Request.HOME)
                    failures += self.accepted - accepted
                case State.ARMED:
                    self._ask(Request.DISARM)
            self._advance(_CHUNK)
        cause = int(self.control["cause"][0])
        self.broken.append(
            f"not READY after {_LONGEST_RECOVERY / 1000:g} s: {self.state.name}, cause {cause}"
        )

    def _ask_as_clients_do(self, request: int) -> None:
        """Ask; ask for a swing again while it waits for the air at the address."""
        self._ask(request)
        for _ in range(_SWINGS_ASKED):
            if request != Request.SWING or self.control["refusal"][0] != Refusal.AIR:
                return
            self._advance(_BETWEEN)
            self._ask(request)

    def _ask(self, request: int) -> None:
        self.asked += 1
        if request == Request.RESET and self.bench.faults is not None:
            revive(self.bench.faults)  # as the loop's process does before the reset is judged
        if request not in (Request.STOP, Request.EMERGENCY_STOP):
            self.number += 1
            self.control["request_number"] = self.number
            self.control["answer"] = Answer.NONE
        cycles = self._advance(1, request)
        self.accepted += bool(cycles["answer"][0] == Answer.ACCEPTED and cycles["request"][0] == request)

    def _press(self) -> None:
        self.judge.pressed(self.bench.tick)
        for pressed in (True, False):
            self.bench.plant_state["local_reset"] = pressed
            self._advance(_PRESS)

    def _move_by_hand(self) -> None:
        """Bring the vented robot to where it hangs, slowly: the air has to leave the chambers."""
        state = self.bench.plant_state
        begun, ticks = state["angle"][0].copy(), 4000
        for part in np.linspace(0.0, 1.0, ticks // 10):
            state["angle"], state["speed"] = begun + part * (self.hanging - begun), 0.0
            self._advance(10)

    def _break(self, faults: tuple[Fault, ...]) -> None:
        """Let exactly `faults` act from now on."""
        before = self.bench.faults
        self.faults = faults
        self.bench.plant = own_records(self.healthy)
        self.bench.faults = new_faults(faults, self.bench.plant, seed=self.setup.seed)
        if before is not None:
            for name in ("passive", "commanded", "silence"):
                self.bench.faults.device[name] = before.device[name]
            self.bench.faults.received[:], self.bench.faults.sent[:] = before.received, before.sent

    def _advance(self, ticks: int, request: int = 0) -> NDArray[Any]:
        if self.bench.tick >= 10:
            self.control["is_warmed_up"] = True
        cycles = self.bench.advance(ticks, request)
        first = self.bench.tick - ticks
        self.judge.look(cycles, first, request, self.number, self.bench.plant_state, self.ever)
        return cycles


def play(story: Story, *, recover: bool = True) -> Player:
    """Return the bench after `story`, and with `recover` after a person has brought it back to READY."""
    player = Player(story.setup)
    for step in story.steps:
        player.do(step)
        if player.broken:
            return player
    if recover:
        player.recover()
    player.judge.end(player.loads, player.ever)
    return player
