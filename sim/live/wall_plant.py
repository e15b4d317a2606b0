"""The plant with its valve node and its surroundings, moved tick by tick at instants that are given."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from drivers.base import COMMAND, PASSIVE, pack_command, unpack_command
from drivers.base.compiled import new_record
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
from sim.live.exchange import CONTACT, PLANT_REPORT, PlantPlan
from sim.live.handled_plant import HandledPlant
from sim.live.valve_watchdog import ValveNode
from sim.plant import advance, build_plant, initial_state, sense
from sim.truth import note_truth

_NEAR = 1e-6
"""Share of a tick by which the watchdog may fall short of one, for rounding."""


class WallPlant:
    """Everything of the plant's process but the process: no clock, no shared memory.

    `report` (PLANT_REPORT) holds what is told of the last tick.
    """

    def __init__(self, plan: PlantPlan) -> None:
        """Stand vented at the plan's angles.

        Raises:
            ValueError: parameters, angles or watchdog do not hold.
        """
        self.plant = build_plant(plan.plant)
        angle = np.asarray(hanging_pose(plan.plant) if plan.angle is None else plan.angle, dtype=float)
        if angle.shape != (3,) or not np.all(np.isfinite(angle)):
            raise ValueError(f"plant: start angles are {plan.angle!r}, expected three finite numbers in rad")
        watchdog_ticks = int(plan.watchdog / plan.plant.tick + _NEAR)
        if watchdog_ticks < 1:
            raise ValueError(
                f"plant: watchdog {plan.watchdog} s is shorter than its tick of {plan.plant.tick} s"
            )
        self.faults: Faults | None = None
        if plan.faults:
            self.plant = own_records(self.plant)
            self.faults = new_faults(plan.faults, self.plant, watchdog=math.inf, seed=plan.plant.seed)
        self.link_up = True
        """Whether commands arrive in this tick."""
        self.state = initial_state(self.plant, angle)
        self.node = ValveNode(watchdog_ticks)
        self.ticks = 0
        self.contacts = 0
        self.report = new_record(PLANT_REPORT)
        self._readings, self._truth = self.report["readings"], self.report["truth"]
        self._node, self._contact = self.report["node"], self.report["contact"]
        self._node["watchdog"] = watchdog_ticks * plan.plant.tick
        self._command, self._in_force = new_record(COMMAND), PASSIVE
        pack_command(PASSIVE, self._command)
        self._handled = HandledPlant(self.plant, self.state)
        sense(self.plant.plant, self.state, self._readings)

    def hear(self, record: np.ndarray[Any, Any]) -> None:
        """Let the valve node hear a PLANT_COMMAND record."""
        if not self.link_up:
            return
        counter, session, mode, _ = record.item()
        self.node.hear(self.ticks, counter, session, mode, unpack_command(record["command"]))

    def surround(self, record: np.ndarray[Any, Any]) -> None:
        """Take over a PLANT_SURROUNDINGS record."""
        self._handled.surround(record)

    def move(self, instant: float) -> None:
        """Move on by one tick, which ends at `instant` (s on the wall's clock)."""
        node, state = self.node, self.state
        node.watch(self.ticks)
        if node.applied is not self._in_force:
            self._in_force = node.applied
            pack_command(node.applied, self._command)
        was_struck = state["struck"][0]
        state["time"] = instant - self.plant.parameters.tick
        advance(
            *self.plant.records, state, self._command if self.faults is None else self._spoilt(self.faults)
        )
        state["time"] = instant  # to the bit, so that stamps are the grid's
        self.ticks += 1
        self.contacts += int(state["struck"][0] and not was_struck)

    def tell(self) -> None:
        """Bring `report` up to date, all but the fields on the process's own timing."""
        state, report, node = self.state, self.report, self.node
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
        self._node[0] = (
            self._node["watchdog"][0],
            node.session,
            node.operational,
            node.passive_by_watchdog,
            node.trips,
            node.counter,
            node.command_tick,
            node.passive_tick,
            node.applied,
        )

    def _spoilt(self, faults: Faults) -> np.ndarray[Any, Any]:
        """Return the command that reaches the plant in this tick; break what is to break in it."""
        robot, plant, _ = self.plant.records
        notice_onsets(faults, plant, self.state, -1)
        self.link_up = bool(faults.device["link_up"][0])
        faults.device["link_up"] = True  # what the link loses the node has not heard; it lets go by itself
        deliver_command(faults, plant, self._command, True)
        break_parts(faults, robot, plant, self.state)
        return faults.sent  # type: ignore[no-any-return]
