"""The plant behind the nodes: its plan, its surroundings, and its ticks at given wall-clock times."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, inf
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import PASSIVE, Triple
from drivers.base.compiled import new_record
from drivers.base.records import COMMAND, pack_command
from sim.driver import hanging_pose
from sim.exchange import CONTACT, PLANT_REPORT, HandledPlant
from sim.faults import (
    Fault,
    Faults,
    break_parts,
    deliver_command,
    deliver_readings,
    new_faults,
    notice_onsets,
    own_records,
)
from sim.nodes.personality import Personality
from sim.plant import PlantParameters, advance, build_plant, initial_state
from sim.sensors import note_truth, sense


@dataclass(frozen=True)
class NodesPlan:
    """Parameters of the process."""

    interface: str
    """python-can interface name."""
    channel: str
    bitrate: int
    encoders: tuple[int, int, int]
    """Node numbers in the order of the joints."""
    valve_node: int
    plant: PlantParameters
    folder: Path
    """Folder of the plant's shared records, see `sim.exchange`."""
    angle: Triple | None = None
    """Joint angles at the start, rad; None for the hanging pose."""
    priority: int = 0
    """Requested SCHED_FIFO priority; 0 for none."""
    cpu: int = -1
    """Processor core; -1 for any."""
    max_catch_up: int = 25
    """Max plant ticks caught up at once after a stall: more than a valve node's watchdog time."""
    faults: tuple[Fault, ...] = ()
    """Faults; no onset by phase."""
    encoder_personality: Personality | None = None
    """Device family that all encoders play; None for the plain one of the EDS file."""
    io_personality: Personality | None = None
    """Device family that the valve node plays; None for the plain one of the EDS file."""


class WallGrid:
    """The multiples of `period` (s) on a clock that is given, from the first one not before `now` on.

    Nothing is ever due before its instant.
    """

    def __init__(self, period: float, now: float, max_catch_up: int) -> None:
        self.period, self.max_catch_up = period, max_catch_up
        self.line = ceil(now / period)
        """Number of the next tick; due at this multiple of the period."""
        self.slips = 0
        self.slipped_ticks = 0

    @property
    def instant(self) -> float:
        """Time at which the next tick is due, s."""
        return self.line * self.period

    def take_due(self, now: float) -> int:
        """Return how many ticks are due at `now` (s), 0 … burst, after skipping those too late.

        The caller executes them and adds one to `line` for each.
        """
        due = floor(now / self.period) - self.line + 1
        if due > self.max_catch_up:
            self.slips += 1
            self.slipped_ticks += due - self.max_catch_up
            self.line += due - self.max_catch_up
            return self.max_catch_up
        return max(due, 0)


class WallPlant:
    """A plant that applies the valve node's command, without clock and shared memory.

    `report` (PLANT_REPORT) describes the last tick.
    """

    def __init__(self, plan: NodesPlan) -> None:
        """Start vented at the plan's angles.

        Raises:
            ValueError: parameters or angles are invalid.
        """
        self.plant = build_plant(plan.plant)
        angle = np.asarray(hanging_pose(plan.plant) if plan.angle is None else plan.angle, dtype=float)
        if angle.shape != (3,) or not np.all(np.isfinite(angle)):
            raise ValueError(f"plant: start angles are {plan.angle!r}, expected three finite numbers in rad")
        self.faults: Faults | None = None
        if plan.faults:
            self.plant = own_records(self.plant)
            self.faults = new_faults(plan.faults, self.plant, watchdog=inf, seed=plan.plant.seed)
        self.link_up = True
        """Whether commands are received in this tick."""
        self.state = initial_state(self.plant, angle)
        self.applied, self.operational = PASSIVE, False
        """Command of the valve node, and its state."""
        self.command_tick = self.passive_tick = self.trips = 0
        """Ticks of its last command and of its last fallback; how often it fell back."""
        self.ticks = 0
        self.contacts = 0
        self.report = new_record(PLANT_REPORT)
        self._readings, self._truth = self.report["readings"], self.report["truth"]
        self._node, self._contact = self.report["node"], self.report["contact"]
        self._command, self._in_force = new_record(COMMAND), PASSIVE
        pack_command(PASSIVE, self._command)
        self._handled = HandledPlant(self.plant, self.state, self.faults)
        sense(self.plant.plant, self.state, self._readings)

    def set_surroundings(self, record: np.ndarray[Any, Any]) -> None:
        """Apply a PLANT_SURROUNDINGS record."""
        self._handled.set_surroundings(record)

    def move(self, instant: float) -> None:
        """Advance by one tick, which ends at `instant` (s, wall clock)."""
        state = self.state
        if self.applied is not self._in_force:
            self._in_force = self.applied
            pack_command(self.applied, self._command)
        was_struck = state["struck"][0]
        state["time"] = instant - self.plant.parameters.tick
        advance(
            *self.plant.records, state, self._command if self.faults is None else self._spoilt(self.faults)
        )
        state["time"] = instant  # to the bit, so that stamps are the grid's
        self.ticks += 1
        self.contacts += int(state["struck"][0] and not was_struck)

    def update_report(self) -> None:
        """Update `report` except for the timing fields of the process."""
        state, report = self.state, self.report
        if not self._handled.frozen:
            if self.faults is None:
                sense(self.plant.plant, state, self._readings)
            else:
                deliver_readings(self.faults, self.plant.plant, state, self._readings)
        note_truth(state, self._truth)
        if state["struck"][0] or self._contact["struck"][0]:
            for name in CONTACT.names or ():
                self._contact[name] = state[name]
        for name in ("stop_energy", "peak_pressure", "lowest_clearance", "peak_head_speed"):
            report[name] = state[name]
        report["contacts"], report["ticks"] = self.contacts, self.ticks
        self._node[0] = self.operational, self.trips, self.command_tick, self.passive_tick, self.applied

    def _spoilt(self, faults: Faults) -> np.ndarray[Any, Any]:
        """Return the command that reaches the plant in this tick; apply faults of parts."""
        robot, plant, _ = self.plant.records
        notice_onsets(faults, plant, self.state, -1)
        self.link_up = bool(faults.device["link_up"][0])
        faults.device["link_up"] = True  # commands lost on the link do not reach the node: its watchdog trips
        deliver_command(faults, plant, self._command, True)
        break_parts(faults, robot, plant, self.state)
        return faults.sent  # type: ignore[no-any-return]
