"""Monitors of manifold and chamber exhausts: with valves shut or vents open a pressure must fall.

Manifold: two bounds, by ISO 6358, with the assumed manifold and dump valve.

- With the supply shut, one falls from the pressure at which it was shut, through a dump valve that passes a
  quarter of the assumed flow. Above it the supply valve did not shut, the dump valve did not open, or the
  sensor is frozen.
- In any tick, one falls from the highest reading, through a dump valve that passes three times as much.
  A lower reading is a sensor fault: no manifold empties that fast. Its value then is no proof that the
  manifold is empty, until a later venting was seen to take its time.

Chambers: a bound falls from the pressure at which the vents opened, also while the arms sink, as in a
simulated chamber whose exhaust passes the fraction MIN_EXHAUST_SHARE of its assumed flow. A chamber above it
has a clogged silencer, a kinked hose or a sensor with a zero error. A vent's position switch shows none of
these faults.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase
from bench.control.estimate.air import actuator_motion, conductance_of_vents
from bench.control.monitor.pressure_monitor import SWITCHING, is_alive
from drivers.base.compiled import compiled
from sim.dynamics import chambers
from sim.pneumatics import flow

MIN_DUMP_SHARE, MAX_DUMP_SHARE = 0.25, 3.0
"""Fractions of the assumed dump valve's flow: silencers clog, and spools still open also take air."""
SHUTTING = 0.3
"""Max closing time of the supply valve (s)."""
MANIFOLD_MARGIN = 0.3e5
"""Margin between a bound and a violation (Pa): noise, and samples as old as a message."""
LATE, EARLY = 0.1, 0.02
"""Times above and below the bounds that count as a fault (s)."""
PROOF_FROM = 3e5
"""Pressure from which slow venting proves the sensor (Pa)."""
PROOF_TIME = 1.5
"""Time from closing until a venting is over (s)."""
_CHOKED = 0.3
"""Critical pressure ratio of the dump valve."""
_MAX_STEP = 0.02
"""Max tick that shows how fast the pressure fell, or moves a chamber's bound (s)."""


@compiled
def monitor_manifold(s: Any, p: Any, plant: Any, readings: Any, powered: bool, step: float) -> None:
    """Judge the manifold's sensor `step` s after the last tick, in which the supply was `powered`.

    `plant` is one of PLANT_PARAMETERS.
    """
    m = s.manifold
    shown = readings[0].supply_pressure
    known = bool(p.lowest_pressure <= shown <= p.highest_pressure)  # False with NaN
    fell_too_fast = _is_too_low(s, plant, shown, known, step)
    if powered or s.tick <= 1:
        m.late = m.shut = 0.0
        m.wrong = False
        if known:
            m.start = m.slow = shown
        if s.tick <= 1:  # unknown before
            m.start, m.slow = plant.atmosphere, plant.regulated
    else:
        m.shut += step
        if m.shut > SHUTTING:
            m.slow = _fallen(plant, m.slow, MIN_DUMP_SHARE, step)
        elif known:
            m.slow = max(m.slow, shown)
    if not known:
        return
    above = not powered and shown > max(m.slow + MANIFOLD_MARGIN, p.vented_pressure)
    m.late = min(m.late + step, LATE) if above else 0.0
    m.wrong = m.late >= LATE
    if fell_too_fast:
        m.unproven, m.excused, m.start = True, False, plant.atmosphere
    elif m.shut > PROOF_TIME and m.start > PROOF_FROM and not above:
        m.unproven = False


@compiled
def _is_too_low(s: Any, plant: Any, shown: float, known: bool, step: float) -> bool:
    """Return whether the pressure `shown` is lower than the manifold's can be after the readings so far.

    Inputs that did not arrive keep their values, and a stalled loop saw none: no fall is judged across that.
    """
    m = s.manifold
    bound = _fallen(plant, m.fast, MAX_DUMP_SHARE, step)
    if not known:
        m.fast = bound
        return False
    if s.encoder_fault != 0 or not s.device_operational or step > _MAX_STEP:
        bound = -np.inf
    # One reading that is too high is no pressure to fall from.
    m.fast = max(bound, min(shown, m.before))
    m.before = shown
    m.early = m.early + step if shown < bound - MANIFOLD_MARGIN else 0.0
    return bool(m.early >= EARLY)


@compiled
def _fallen(plant: Any, pressure: float, share: float, step: float) -> float:
    """Return `pressure` (Pa) after `step` s through `share` of the dump valve; never below the atmosphere."""
    if not pressure > plant.atmosphere:
        return pressure
    out = flow(share * plant.dump_conductance, pressure, plant.atmosphere, _CHOKED)
    fallen: float = max(pressure - step * plant.exponent / plant.manifold * out, plant.atmosphere)
    return fallen


MIN_EXHAUST_SHARE = 1.0 / 3.0
"""Fraction of an exhaust's assumed flow below which the exhaust is faulty."""
EXHAUST_MARGIN = 2e3
"""Margin between the bound and a violation (Pa): a sensor's noise and zero."""
CHAMBERS = 6


@compiled
def monitor_exhausts(s: Any, p: Any, robot: Any, plant: Any, e: Any, readings: Any, step: float) -> None:
    """Judge each chamber that a living sensor shows, `step` s after the last tick.

    `plant` is one of PLANT_PARAMETERS, `e` the estimator's state. Without trusted encoders, or before
    incremental ones are homed, a chamber's volume is unknown: none is judged, and earlier findings stay.
    """
    opened = s.venting.timer - SWITCHING
    vent = MIN_EXHAUST_SHARE * conductance_of_vents(plant, readings[0], opened)
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
            above = shown > max(s.exhausts.bound[6 + k] + EXHAUST_MARGIN, p.holding_pressure)
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
