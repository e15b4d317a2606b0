"""Monitor of the chambers' exhausts: with the vents open a pressure must fall, also while the arms sink.

The bound falls from the pressure at which the vents opened, as in a simulated chamber whose exhaust passes
the fraction MIN_FLOW_SHARE of its assumed flow. A chamber above it has a clogged silencer, a kinked hose or a
sensor with a zero error. A vent's position switch shows none of these faults.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase
from bench.control.estimate.air import actuator_motion, conductance_of_vents
from bench.control.monitor.pressure_monitor import SWITCHING, is_alive
from drivers.base.compiled import compiled
from sim.dynamics import chambers

MIN_FLOW_SHARE = 1.0 / 3.0
"""Share of an exhaust's assumed flow below which it is a fault."""
MARGIN = 2e3
"""Margin between the bound and a violation (Pa): a sensor's noise and zero."""
LATE = 0.1
"""Time above the bound after which an exhaust is too slow (s)."""
CHAMBERS = 6
_MAX_STEP = 0.02
"""Longest time, s, by which a tick moves the bounds: a stalled loop has read nothing."""


@compiled
def monitor_exhausts(s: Any, p: Any, robot: Any, plant: Any, e: Any, readings: Any, step: float) -> None:
    """Judge each chamber that a living sensor shows, `step` s after the last tick.

    `plant` is one of PLANT_PARAMETERS, `e` the estimator's state. Without trusted encoders, or before
    incremental ones are homed, a chamber's volume is unknown: none is judged, and earlier findings stay.
    """
    opened = s.venting.timer - SWITCHING
    vent = MIN_FLOW_SHARE * conductance_of_vents(plant, readings[0], opened)
    known = s.encoder_fault == 0 and not s.encoders_suspect and (s.homed or not p.home_by_index)
    known = known and np.isfinite(e.angle.sum() + e.velocity.sum())
    judged = vent > 0.0 and s.phase == Phase.STANDING and known
    supply = readings[0].supply_pressure
    s.exhausts.bound[12] = supply if p.lowest_pressure <= supply <= p.highest_pressure else plant.atmosphere
    for i in range(3):
        if judged:
            _let_fall(s, robot, plant, e, vent, min(step, _MAX_STEP), i)
        for k in range(2 * i, 2 * i + 2):
            shown, alive = s.sensors.shown[1 + k], is_alive(s.sensors, 1 + k)
            if not (judged and alive):
                s.exhausts.bound[6 + k] = max(shown, plant.atmosphere) if alive else p.highest_pressure
            above = shown > max(s.exhausts.bound[6 + k] + MARGIN, p.holding_pressure)
            s.exhausts.late[k] = min(s.exhausts.late[k] + step, LATE) if judged and alive and above else 0.0
            if s.exhausts.late[k] >= LATE:
                s.exhausts.slow[k] = 1


@compiled
def _let_fall(s: Any, robot: Any, plant: Any, e: Any, vent: float, step: float, i: int) -> None:
    """Move the bounds of actuator `i` on by `step` s through `vent`, m3/(s Pa)."""
    position, speed = actuator_motion(robot, plant, e.angle, e.velocity, i)
    chambers(plant, i, s.exhausts.bound, s.exhausts.rate, 0.0, position, speed, vent)
    for k in range(6 + 2 * i, 8 + 2 * i):
        s.exhausts.bound[k] = max(s.exhausts.bound[k] + step * s.exhausts.rate[k], plant.atmosphere)


@compiled
def exhaust_cause(exhausts: Any) -> int:
    """Return the cause that names the first exhaust found too slow, or 0."""
    for k in range(CHAMBERS):
        if exhausts.slow[k] != 0:
            return Cause.SHOULDER_A_EXHAUST + k
    return 0
