"""The plant behind the nodes, with its surroundings, advanced tick by tick at given times."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from drivers.base import PASSIVE
from drivers.base.compiled import new_record
from drivers.base.records import COMMAND, pack_command
from sim.driver import hanging_pose
from sim.faults import (
    Faults,
    break_parts,
    deliver_command,
    deliver_readings,
    new_faults,
    notice_onsets,
    own_records,
)
from sim.live.exchange import CONTACT, PLANT_REPORT
from sim.live.handled_plant import HandledPlant
from sim.nodes.plan import NodesPlan
from sim.plant import advance, build_plant, initial_state, sense
from sim.truth import note_truth


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
            self.faults = new_faults(plan.faults, self.plant, watchdog=math.inf, seed=plan.plant.seed)
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
